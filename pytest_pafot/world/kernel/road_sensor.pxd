cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bends cimport Bends
from pytest_pafot.world.kernel.observation cimport Sensor, lateral_velocity
from pytest_pafot.world.kernel.places cimport OwnWay, RoadPlaces

cdef double HALF_TURN
cdef int COLUMNS

cdef class RoadSensor(Sensor):
    cdef RoadPlaces _places
    cdef double[::1] _record
    cdef Bends _bends
    cdef list _leaning, _zones, _sizes
    cdef tuple _common
    cdef int _physics_hz, _every
    cdef object _sight, _seed
    cdef double _drift

    cpdef bint has_lane(self, int lane) except -1

    @cython.locals(bends=Bends, own_bends=Bends, record="double[::1]", places=RoadPlaces, count=Py_ssize_t,
                   row=Py_ssize_t, x=double, y=double, heading=double, speed=double, own=double, across=double, stretch=double, cos=double,
                   sin=double, then=Py_ssize_t, npc=Py_ssize_t, error_x=double, error_y=double, error_speed=double,
                   at=Py_ssize_t, its_x=double, its_y=double, its_heading=double, its_speed=double, along=double,
                   way=OwnWay, dx=double, dy=double, turned=double)
    cpdef observation(self, int tick)

    @cython.locals(bends=Bends, own_bends=Bends, along=double, lane=int, driven=double, to_lane=double, y=double, leaning=double)
    cdef _state(self, Py_ssize_t number, double speed, double steering, double own, double stretch)
