cimport cython
from libc cimport math

cdef double SLACK, LARGE, LONGEST, UNENDING, TINY

@cython.locals(tick=Py_ssize_t, vehicle=Py_ssize_t, column=Py_ssize_t, size=double, comes=bint, near=bint,
               min_ttc=double, min_gap=double, max_shortfall=double, al=double, aw=double, bl=double, bw=double,
               heading_a=double, speed_a=double, acceleration_a=double, lane_a=double, turn_a=double, fast_a=double,
               heading_b=double, speed_b=double, turn_b=double, fast_b=double, x=double, y=double, room_x=double,
               room_y=double, apart=double, closing=double, gain=double, pull=double, keep=double, demanded=double,
               ac=double, sa=double, bc=double, sb=double, cos=double, sin=double, c=double, s=double,
               reach_0=double, reach_1=double, reach_2=double, reach_3=double, offset_0=double, offset_1=double,
               offset_2=double, offset_3=double, vx=double, vy=double, begins=double, ends=double, gap=double,
               from_a=double, from_b=double)
cdef tuple _swept(const double[:, :, ::1] states, const double[:, ::1] sizes, double road_cos, double road_sin,
                  double seconds)

@cython.locals(distance=double, parting=double, near=double, far=double, first=double, last=double)
cdef (double, double) _cut(double begins, double ends, double offset, double reach, double velocity) noexcept

@cython.locals(corner=Py_ssize_t, along=double, across=double, outside_u=double, outside_v=double, square=double,
               nearest=double)
cdef double _corners_to_box(double u, double v, double length_u, double length_v, double width_u, double width_v,
                            double half_length, double half_width) noexcept
