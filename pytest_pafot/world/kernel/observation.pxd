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

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t, x=double, y=double, heading=double)
    cdef void fill(self, int tick, double[:, :, ::1] values, Py_ssize_t run) except *

    @cython.locals(seen=Observation)
    cpdef Observation observation(self, int tick)

cdef class Observation:
    cdef object _ego, _others
    cdef Observer _observer
    cdef int _tick, _lanes
    cdef double _time, _lane_width, _speed_limit

    cdef Py_ssize_t _count(self) except -1
    @cython.locals(index=Py_ssize_t, column=Py_ssize_t)
    cdef void _fill(self, double[:, :, ::1] values, Py_ssize_t run) except *

@cython.locals(seen=Observation, most=Py_ssize_t, run=Py_ssize_t, values="double[:, :, ::1]")
cpdef stacked(observations)
