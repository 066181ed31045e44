cimport cython
from libc cimport math
from pytest_pafot.world.kernel.action cimport possible_acceleration, possible_steering
from pytest_pafot.world.kernel.driver cimport clamped

cdef double KP_HEADING, KP_LATERAL, KP_SPEED, STEEPEST

cpdef double steering_to_lane(double offset, double heading, double speed, double length) except? -1
cpdef double acceleration_to_speed(double wanted, double speed) except? -1

@cython.locals(divisor=double, sideways=double, turn=double, slip=double)
cpdef double lane_steering(double offset, double heading, double speed, double length, double kp_heading,
                           double kp_lateral) except? -1

cpdef double not_zero(double value) except? -1
