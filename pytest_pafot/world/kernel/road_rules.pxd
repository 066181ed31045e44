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
cdef class EgosRoadRules:
    cdef NetworkVehicle _ego
    cdef Places _places
    cdef Bends _bends
    cdef Network _network
    cdef int[::1] _priorities
    cdef int _steps, _every
    cdef double _lasts
    cdef double[::1] _predicted

    @cython.locals(ego=NetworkVehicle, number=Py_ssize_t, npc=Body, moment=int)
    cpdef apply_to_ego(self)

    cdef _release(self, NetworkVehicle vehicle)

    @cython.locals(network=Network, here=double, moment=int, along=double, place=Py_ssize_t, at=int, route=list)
    cdef _predict(self, NetworkVehicle vehicle)

    cdef _foresee(self, Py_ssize_t row, double x, double y, double heading)

    @cython.locals(row=Py_ssize_t, its_row=Py_ssize_t, x=double, y=double, heading=double, its_x=double, its_y=double,
                   its_heading=double, dx=double, dy=double)
    cdef bint _conflict(self, Body one, Body other) except -1

    @cython.locals(mine=int, theirs=int, dx=double, dy=double, ahead=double)
    cdef bint _comes_second(self, NetworkVehicle one, Body other) except -1

    @cython.locals(bends=Bends, along=double, npc=CrossingNpc, heading=double, across=double, x=double, y=double)
    cdef _foresee_npc(self, Py_ssize_t row, Body body, double time)

@cython.locals(cos=double, sin=double, other_cos=double, other_sin=double, along=int, across=int, ahead=double,
               aside=double, dx=double, dy=double, turned_x=double, turned_y=double)
cdef bint _has_corner_inside(double x, double y, double heading, double length, double width, double other_x,
                             double other_y, double other_heading, double other_length, double other_width) except -1
