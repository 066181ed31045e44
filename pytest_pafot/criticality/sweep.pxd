cimport cython
from libc cimport math

cdef double SLACK, LARGE, LONGEST, TINY

@cython.final
cdef class Sweep:
    cdef readonly double min_ttc, min_gap, max_safety_shortfall
    cdef const double[:, :, ::1] _states
    cdef const double[:, ::1] _sizes
    cdef Py_ssize_t _ticks, _vehicles
    cdef double _road_cos, _road_sin, _seconds, _half_seconds_squared
    cdef double _ax, _ay, _speed_a, _acceleration_a, _lane_a, _heading_a, _ac, _as, _al, _aw
    cdef double _x, _y, _speed_b, _acceleration_b, _lane_b, _heading_b, _bc, _bs, _bl, _bw
    cdef double _turn_cos, _turn_sin, _reach_0, _reach_1, _reach_2, _reach_3
    cdef double _offset_0, _offset_1, _offset_2, _offset_3, _begins, _ends

    @cython.locals(tick=Py_ssize_t, vehicle=Py_ssize_t)
    cpdef bint run(self) except -1

    @cython.locals(vehicle=Py_ssize_t, column=Py_ssize_t, size=double)
    cdef bint _is_sane(self, Py_ssize_t tick) noexcept

    cdef void _see_ego(self, Py_ssize_t tick) noexcept

    cdef void _see(self, Py_ssize_t tick, Py_ssize_t vehicle) noexcept

    @cython.locals(turn_a=double, turn_b=double, room_x=double, room_y=double, comes=bint, near=bint, apart=double,
                   keep=double, demanded=double, time=double, gap=double)
    cdef void _measure(self) noexcept

    @cython.locals(fast_a=double, fast_b=double, closing=double)
    cdef bint _may_come(self, double room_x, double room_y, double turn_a, double turn_b) noexcept

    @cython.locals(gain=double, pull=double, distance=double)
    cdef double _safety_distance(self) noexcept

    @cython.locals(ac=double, sa=double, bc=double, sb=double, x=double, y=double, c=double, s=double)
    cdef void _relate(self) noexcept

    @cython.locals(ac=double, sa=double, bc=double, sb=double, vx=double, vy=double)
    cdef double _contact_time(self) noexcept

    @cython.locals(distance=double, parting=double, near=double, far=double, first=double, last=double)
    cdef void _cut(self, double offset, double reach, double velocity) noexcept

    @cython.locals(cos=double, sin=double, al=double, aw=double, bl=double, bw=double, from_a=double, from_b=double)
    cdef double _gap(self) noexcept

@cython.locals(nearest=double, square=double)
cdef double _corners_to_box(double u, double v, double length_u, double length_v, double width_u, double width_v,
                            double half_length, double half_width) noexcept

@cython.locals(outside_u=double, outside_v=double)
cdef double _square(double u, double v, double half_length, double half_width) noexcept
