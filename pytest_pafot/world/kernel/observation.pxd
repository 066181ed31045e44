cimport cython
from libc cimport math
from pytest_pafot.world.kernel.lanes cimport Bends, Lanes, Places, Track

cdef object _NEW
cdef double HALF_TURN
cdef int COLUMNS

cpdef double lateral_velocity(double heading, double speed, double steering) except? -1e300


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
    cdef readonly double physics_hz
    cdef readonly int every, columns
    cdef double _x0, _y0

    @cython.locals(row=Py_ssize_t, lane=int)
    cdef vehicle(self, int tick, int index)

    @cython.locals(row=Py_ssize_t, count=Py_ssize_t)
    cdef details(self, int tick)

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t, first=Py_ssize_t, columns=Py_ssize_t, record="double[::1]",
                   values=list)
    cdef tuple lateral_velocities(self, int tick)

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t)
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

cdef class RoadSensor(Sensor):
    cdef Places _places
    cdef double[::1] _record
    cdef Bends _bends
    cdef list _leaning, _zones, _sizes
    cdef tuple _common
    cdef double _physics_hz
    cdef int _every
    cdef object _sight, _seed
    cdef double _drift

    cpdef bint has_lane(self, int lane) except -1

    @cython.locals(bends=Bends, own_bends=Bends, record="double[::1]", places=Places, count=Py_ssize_t, row=Py_ssize_t,
                   x=double, y=double, heading=double, speed=double, own=double, across=double, stretch=double,
                   cos=double, sin=double, then=Py_ssize_t, npc=Py_ssize_t, error_x=double, error_y=double,
                   error_speed=double, at=Py_ssize_t, its_x=double, its_y=double, its_heading=double, its_speed=double,
                   along=double, way=Track, dx=double, dy=double, turned=double)
    cpdef observation(self, int tick)

    @cython.locals(bends=Bends, own_bends=Bends, lane=int)
    cdef _state(self, Py_ssize_t number, double speed, double steering, double own, double stretch)
