cimport cython
from pytest_pafot.world.kernel.lanes cimport Lanes

@cython.final
cdef class Observer:
    cdef readonly double[::1] record
    cdef readonly list sizes
    cdef readonly Lanes lanes
    cdef readonly double speed_limit
    cdef readonly int physics_hz, columns

    @cython.locals(row=Py_ssize_t, x=double, y=double, heading=double, lane=int)
    cdef vehicle(self, int tick, int index)

    @cython.locals(seen=Observation)
    cpdef Observation observation(self, int tick)

cdef class Observation:
    cdef object _ego, _others
    cdef Observer _observer
    cdef int _tick, _lanes
    cdef double _time, _lane_width, _speed_limit
