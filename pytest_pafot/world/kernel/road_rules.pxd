cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bends cimport Bends
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.crossing cimport CrossingNpc
from pytest_pafot.world.kernel.lane_network cimport Network
from pytest_pafot.world.kernel.network_vehicle cimport NetworkVehicle
from pytest_pafot.world.kernel.places cimport Places

cdef int MOMENTS
cdef double APART, LONGER, NARROWER

@cython.final
cdef class RoadRules:
    cdef NetworkVehicle _ego
    cdef Places _places
    cdef Bends _bends
    cdef Network _network
    cdef int[::1] _priorities
    cdef object _route
    cdef int _steps, _every, _waited
    cdef double _lasts, _x, _y, _heading
    cdef double[::1] _predicted

    @cython.locals(ego=NetworkVehicle, network=Network, lane=int, number=Py_ssize_t, npc=Body)
    cpdef apply(self)

    @cython.locals(ego=NetworkVehicle, network=Network, here=double, moment=int, along=double, place=Py_ssize_t, at=int)
    cdef _predict(self, int lane)

    @cython.locals(ego=NetworkVehicle, moment=int, x=double, y=double, heading=double, dx=double, dy=double)
    cdef bint _conflicts(self, Body npc, Body body) except -1

    @cython.locals(bends=Bends, along=double, npc=CrossingNpc, heading=double, across=double)
    cdef _foresee(self, Body body, double time)

    @cython.locals(ego=NetworkVehicle, network=Network, mine=int, theirs=int, dx=double, dy=double, ahead=double)
    cdef bint _comes_second(self, int lane, Body npc) except -1

@cython.locals(cos=double, sin=double, other_cos=double, other_sin=double, along=int, across=int, ahead=double,
               aside=double, dx=double, dy=double, turned_x=double, turned_y=double)
cdef bint _has_corner_inside(double x, double y, double heading, double length, double width, double other_x,
                             double other_y, double other_heading, double other_length, double other_width) except -1
