cimport cython
from libc cimport math
from pytest_pafot.world.kernel.lanes cimport Lanes

cpdef double lateral_velocity(double heading, double speed, double steering) except? -1e300

cdef object _NEW

cdef class Sensor:
    cdef public bint is_bent
    cdef public double along, across, heading, bend

    cpdef observation(self, int tick)
    cpdef bint has_lane(self, int lane) except -1

cdef class Observer(Sensor):
    cdef readonly double[::1] record
    cdef readonly list sizes
    cdef readonly Lanes lanes
    cdef readonly double speed_limit
    cdef readonly int physics_hz, every, columns
    cdef double _x0, _y0

    @cython.locals(row=Py_ssize_t, x=double, y=double, heading=double, lane=int)
    cdef vehicle(self, int tick, int index)

    @cython.locals(row=Py_ssize_t, count=Py_ssize_t)
    cdef details(self, int tick)

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t, first=Py_ssize_t, columns=Py_ssize_t, record="double[::1]",
                   values=list)
    cdef tuple lateral_velocities(self, int tick)

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t, x=double, y=double, heading=double)
    cdef void fill(self, int tick, double[:, :, ::1] values, Py_ssize_t run) except *

    @cython.locals(seen=Observation)
    cpdef observation(self, int tick)

cdef class Observation:
    cdef object _ego, _others, _details, _lateral
    cdef Observer _observer
    cdef int _tick, _lanes
    cdef double _time, _lane_width, _speed_limit

    cdef _detailed(self)
    cdef Py_ssize_t _count(self) except -1
    @cython.locals(index=Py_ssize_t, column=Py_ssize_t)
    cdef void _fill(self, double[:, :, ::1] values, Py_ssize_t run) except *

@cython.locals(seen=Observation, most=Py_ssize_t, run=Py_ssize_t, values="double[:, :, ::1]")
cpdef stacked(observations)
