cimport cython
from libc cimport math
from pytest_pafot.world.kernel.action cimport lane_steering
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.driver cimport clamped
from pytest_pafot.world.kernel.idm cimport GoalVehicle
from pytest_pafot.world.kernel.lane_network cimport Network

cdef double PURSUIT, ON_LANE, NOWHERE

cdef class StaticObstacle(Body):
    pass

cdef class NetworkVehicle(GoalVehicle):
    cdef Network _network
    cdef object _following, _route
    cdef list _searched

    cpdef list route(self)

    cdef int _found(self, Body vehicle) except -1

    cdef _follow_road(self)

    cdef bint _has_beside(self, int lane, int side) except -1

    cdef bint _reaches(self, int lane) except -1

    @cython.locals(number=int)
    cdef bint _is_demanded(self, int lane) except -1

    cdef double _pulled(self, Body vehicle, Body front) except? -1

    @cython.locals(network=Network, lane=int, there=double)
    cdef double _apart(self, Body vehicle, Body front) except? -1

    cdef double _limit(self, Body vehicle) except? -1

    cdef int _lane_of(self, Body vehicle) except -1

    @cython.locals(network=Network, goal=int, offset=double, ahead=double, angle=double)
    cdef double _steering(self) except? -1

    @cython.locals(found=Body, nearest=double, own=double, other=Body, along=double)
    cdef Body _ahead(self, list others, int lane)

    @cython.locals(found=Body, nearest=double, own=double, other=Body, along=double)
    cdef Body _behind(self, list others, int lane)

    @cython.locals(network=Network, each=int, begins=double)
    cdef double _along(self, int lane, Body other) except? -1
