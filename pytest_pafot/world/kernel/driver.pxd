cimport cython
from libc cimport math

cdef double SPEED_GAIN, GAP_GAIN, GAP_BRAKING, LATERAL_GAIN, HEADING_GAIN, LATERAL_SHARE
cdef double TURNED_SHARE, MARGIN, FOLLOWING_GAP, FOLLOWING_TIME, FOLLOWING_BRAKING, MAX_SLIP, LEAST_SPARE
cdef double CAR_LENGTH, LANE_ANGLE, TRACKING_SHARE, TRACKING_GAIN, CLOSEST_GAIN, SPEEDING_UP, USEFUL_WIDTH, HALF_TURN

cpdef double gap_speed(double distance) except? -1
cpdef double following_speed(double gap, double leader_speed, double own_speed) except? -1
cpdef double following_gap(double speed) except? -1
cpdef double speed_for_braking(double braking, double speed) except? -1
cpdef double stopping_room(double top_speed) except? -1
cpdef bint clear_to_enter(double gap, double closing_speed) except -1
cpdef double closing_room(double gap, double closing_speed) except? -1
cpdef double clamp(double value, double bound) except? -1

@cython.final
cdef class NpcDriver:
    cdef public double course
    cdef readonly double top_speed
    cdef double _dt, _lateral_speed, _acceleration, _braking, _jerk_step, _jerk_twice, _half_length, _lateral_limit
    cdef double _slow, _tightest, _most, _swing, _heading_gain

    cpdef double acceleration(self, double wanted_speed, double previous, double speed) except? -1

    cdef double _released(self, double acceleration, double speed) except? -1

    cpdef double steering(self, double offset, double heading, double course, double speed) except? -1

    @cython.locals(aside=double)
    cpdef double steering_in_bend(self, double offset, double heading, double course, double speed, double lean,
                                  double turn, double sharpest) except? -1

cpdef double wrap_angle(double angle) except? -1e300

@cython.final
cdef class LaneTracker:
    cdef double _dt, _half_length, _tightest, _gain, _course, _acceleration, _angle

    cpdef void begin(self, double heading, double angle, double speed, double most) except *

    cpdef double steering(self, double offset, double heading, double speed, double most, double jerk) except? -1

    cdef double _towards(self, double missing, double jerk) except? -1
