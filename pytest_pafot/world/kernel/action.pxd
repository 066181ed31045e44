from libc cimport math

cdef double EGO_ACCELERATION, EGO_BRAKING, EGO_STEERING

cpdef checked_si_action(object action, int lanes)
cpdef double possible_acceleration(double wanted) except? -1
cpdef double possible_steering(double wanted) except? -1
cpdef double without_reversing(double wanted, double speed, double dt) except? -1
