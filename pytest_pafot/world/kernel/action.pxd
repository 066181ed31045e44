from libc cimport math
from pytest_pafot.world.kernel.driver cimport clamp

cdef double EGO_ACCELERATION, EGO_BRAKING, EGO_STEERING
cdef double KP_SPEED, STEEPEST

cpdef checked_si_action(object action, int lanes)
cpdef double possible_acceleration(double wanted) except? -1
cpdef double possible_steering(double wanted) except? -1
cpdef double without_reversing(double wanted, double speed, double dt) except? -1
cpdef double acceleration_to_speed(double wanted, double speed) except? -1

cpdef double lane_steering(double offset, double ahead, double heading, double speed, double length,
                           double kp_heading, double kp_lateral) except? -1

cpdef double not_zero(double value) except? -1
