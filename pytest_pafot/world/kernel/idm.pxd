cimport cython
from libc cimport math
from pytest_pafot.world.kernel.action cimport lane_steering, not_zero
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.driver cimport clamped
from pytest_pafot.world.kernel.lanes cimport Lanes

cdef double ON_LANE, LANE_ENDS

cdef class GoalVehicle(Body):
    cdef Lanes _lanes
    cdef double _speed_limit, _acc_max, _comfort, _braking, _distance, _time, _delta, _politeness, _min_gain
    cdef double _max_imposed, _delay, _kp_heading, _kp_lateral, _kp_speed, _max_steering, _target_speed
    cdef public bint has_goal, drives_itself
    cdef public double timer
    cdef bint _changes_lanes
    cdef public int waited
    cdef int _closest, _goal, _routed

    cpdef start(self, double x, double y, double heading, double speed, bint changes_lanes)

    cpdef aim(self, int goal, double wanted)

    cpdef want(self, double speed)

    cpdef void stay(self, int lane)

    cpdef tuple seen(self)

    cpdef pursue(self)

    @cython.locals(acceleration=double, there=double)
    cpdef void act(self, list others) except *

    cpdef void step(self, double dt) except *

    cdef int _found(self, Body vehicle) except -1

    cdef _follow_road(self)

    cdef bint _is_demanded(self, int lane) except -1

    cdef bint _has_beside(self, int lane, int side) except -1

    @cython.locals(lane=int, side=int)
    cdef void _choose_lane(self, list others) except *

    @cython.locals(lateral=double, inside=bint)
    cdef bint _reaches(self, int lane) except -1

    @cython.locals(ahead=Body, behind=Body, left=Body, follower=Body, behind_then=double, own=double, own_gain=double,
                   others_gain=double)
    cdef bint _gains(self, int lane, list others) except -1

    @cython.locals(wanted=double, liked=double, share=double, acceleration=double, gap=double)
    cdef double _pulled(self, Body vehicle, Body front) except? -1

    cdef double _apart(self, Body vehicle, Body front) except? -1

    cdef double _limit(self, Body vehicle) except? -1

    @cython.locals(cos_h=double, sin_h=double, closing_x=double, closing_y=double, closing=double, ab=double)
    cdef double _desired_gap(self, Body vehicle, Body front) except? -1

    @cython.locals(offset=double, angle=double)
    cdef double _steering(self) except? -1

    @cython.locals(found=Body, other=Body)
    cdef Body _ahead(self, list others, int lane)

    @cython.locals(found=Body, other=Body)
    cdef Body _behind(self, list others, int lane)

@cython.locals(inside=bint)
cdef bint _is_on(Body vehicle, int lane, Lanes lanes) except -1
