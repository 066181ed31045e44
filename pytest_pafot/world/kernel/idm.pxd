cimport cython
from libc cimport math
from pytest_pafot.world.kernel.action cimport lane_steering, not_zero
from pytest_pafot.world.kernel.lanes cimport Bends, Body, Lanes, Places
from pytest_pafot.world.kernel.crossing cimport CrossingNpc
from pytest_pafot.world.kernel.driver cimport clamp
from pytest_pafot.world.kernel.lane_network cimport Network

cdef double ON_LANE, LANE_ENDS, PURSUIT, NOWHERE, APART, LONGER, NARROWER
cdef int MOMENTS

cdef class GoalVehicle(Body):
    cdef Lanes _lanes
    cdef double _speed_limit, _acc_max, _comfort, _braking, _distance, _time, _delta, _politeness, _min_gain
    cdef double _max_imposed, _delay, _kp_heading, _kp_lateral, _kp_speed, _max_steering
    cdef public bint has_goal, drives_itself
    cdef public double timer, target_speed
    cdef bint _changes_lanes
    cdef public int waited, closest, goal
    cdef int _routed

    cpdef pursue(self)

    cpdef void act(self, list others) except *

    cpdef void step(self, double dt) except *

    cdef int _find_lane(self, Body vehicle) except -1

    cdef _follow_road(self)

    cdef bint _is_demanded(self, int lane) except -1

    cdef bint _has_beside(self, int lane, int side) except -1

    @cython.locals(lane=int, side=int)
    cdef void _choose_lane(self, list others) except *

    @cython.locals(lateral=double, inside=bint)
    cdef bint _reaches(self, int lane) except -1

    @cython.locals(ahead=Body, behind=Body, left=Body, follower=Body)
    cdef bint _gains(self, int lane, list others) except -1

    cdef double _idm(self, Body vehicle, Body front) except? -1

    cdef double _distance_to(self, Body vehicle, Body front) except? -1

    cdef double _speed_limit_of(self, Body vehicle) except? -1

    cdef double _desired_gap(self, Body vehicle, Body front) except? -1

    cdef double _steering(self) except? -1

    @cython.locals(found=Body, other=Body)
    cdef Body _ahead(self, list others, int lane)

    @cython.locals(found=Body, other=Body)
    cdef Body _behind(self, list others, int lane)

@cython.locals(inside=bint)
cdef bint _is_on(Body vehicle, int lane, Lanes lanes) except -1

cdef class StaticObstacle(Body):
    pass

cdef class NetworkVehicle(GoalVehicle):
    cdef Network _network
    cdef object _following, _route
    cdef list _searched

    cdef int _find_lane(self, Body vehicle) except -1

    cdef _follow_road(self)

    cdef bint _has_beside(self, int lane, int side) except -1

    cdef bint _reaches(self, int lane) except -1

    cdef bint _is_demanded(self, int lane) except -1

    cdef double _idm(self, Body vehicle, Body front) except? -1

    @cython.locals(network=Network)
    cdef double _distance_to(self, Body vehicle, Body front) except? -1

    cdef double _speed_limit_of(self, Body vehicle) except? -1

    cdef int _lane_of(self, Body vehicle) except -1

    @cython.locals(network=Network)
    cdef double _steering(self) except? -1

    @cython.locals(found=Body, nearest=double, own=double, other=Body, along=double)
    cdef Body _ahead(self, list others, int lane)

    @cython.locals(found=Body, nearest=double, own=double, other=Body, along=double)
    cdef Body _behind(self, list others, int lane)

    @cython.locals(network=Network, each=int, begins=double)
    cdef double _along(self, int lane, Body other) except? -1

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

    @cython.locals(network=Network, moment=int, place=Py_ssize_t, at=int, route=list)
    cdef _predict(self, NetworkVehicle vehicle)

    cdef _foresee(self, Py_ssize_t row, double x, double y, double heading)

    @cython.locals(row=Py_ssize_t, its_row=Py_ssize_t)
    cdef bint _conflict(self, Body one, Body other) except -1

    @cython.locals(predicted="double[::1]", along=int, across=int)
    cdef bint _has_corner_inside(self, Body one, Py_ssize_t row, Body other, Py_ssize_t its_row) except -1

    cdef bint _comes_second(self, NetworkVehicle one, Body other) except -1

    cdef _foresee_npc(self, Py_ssize_t row, Body body, double time)
