cimport cython
from libc cimport math

cdef double MAX_SPEED, ALMOST, STEP, HALF_TURN, ON_LANE, NOWHERE, NOT_ON_WAY
cdef int ROW_LENGTH, TRACK_COLUMNS

cdef class Box:
    cdef public double x, y, heading, length, width

cdef class Body(Box):
    cdef public double speed, acceleration, steering
    cdef public int lane

    cpdef void place(self, double x, double y, double heading, double speed)

    cpdef void step(self, double dt)

cpdef bint overlap(Box a, Box b) except -1

cpdef double depth(Box a, Box b) except? -1

cpdef (double, double) separation(Box a, Box b)

@cython.final
cdef class Lanes:
    cdef readonly int count
    cdef readonly double width, length
    cdef double _inside, _last, _left, _right

    @cython.locals(offset=double, lane=int)
    cpdef int locate(self, Body body) except -2

    @cython.locals(near=int, best=double, lane=int, index=int)
    cpdef int closest(self, double along, double across, double heading) except -1

@cython.locals(below=Py_ssize_t)
cpdef Py_ssize_t even_rounded(double exact) except? -1

@cython.final
cdef class Bends:
    cdef readonly double along, across, angle, offset
    cdef readonly int lane
    cdef tuple _given
    cdef double[::1] _x, _y, _heading, _across, _direction, _lean, _speed, _sharpest, _widths
    cdef int[::1] _exists, _part
    cdef Py_ssize_t _points
    cdef int _lanes
    cdef double _end, _lane_width, _share, _x0, _y0, _direction0

    cpdef Py_ssize_t point(self, double along) except -1

    cpdef bint exists(self, int lane, double along) except -1

    @cython.locals(row=Py_ssize_t)
    cpdef bint continues(self, int lane, double since, double until) except -1

    @cython.locals(index=Py_ssize_t)
    cdef Py_ssize_t _between(self, double along) except -1

    @cython.locals(index=Py_ssize_t)
    cdef double _value(self, double[::1] values, int lane, double along) except? -1

    cpdef double across_at(self, int lane, double along) except? -1

    cpdef double direction_at(self, int lane, double along) except? -1

    cpdef double lean_at(self, int lane, double along) except? -1

    cpdef double sharpest_at(self, int lane, double along) except? -1

    cpdef double heading_at(self, double along) except? -1

    cpdef double speed_at(self, int lane, double along) except? -1

    @cython.locals(index=Py_ssize_t)
    cpdef double stretch(self, double along, double across) except? -1

    @cython.locals(index=Py_ssize_t)
    cdef void _refer(self, double along) except *

    @cython.locals(cos=double, ahead=double, point=Py_ssize_t, nearest=int, best=double, lane=int)
    cpdef void locate(self, double x, double y, double heading, double near) except *

    @cython.locals(toward=int)
    cpdef double in_lanes(self, int lane, double along, double offset) except? -1

    cpdef int part(self, int lane, double along, double offset) except -2

    @cython.locals(nearest=int)
    cpdef int nearest_lane(self, double lateral) except -2

@cython.final
cdef class Track:
    cdef readonly double along, across, direction
    cdef readonly double[::1] x, y, heading, lean, speed, sharpest, along_ego
    cdef readonly int[::1] parts
    cdef readonly double enters
    cdef tuple _given
    cdef Py_ssize_t _last

    cpdef Py_ssize_t point(self, double along) except -1

    @cython.locals(index=Py_ssize_t, inside=double, dx=double, dy=double, cos=double, sin=double)
    cpdef void locate(self, double x, double y, double near) except *

    @cython.locals(index=Py_ssize_t)
    cpdef double value(self, double[::1] values, double along) except? -1

cdef class Places:
    cdef readonly list vehicles, bodies
    cdef public list obstacles
    cdef public object left
    cdef readonly Lanes lanes
    cdef readonly double[::1] track, on_way
    cdef Lanes _lanes
    cdef Bends _bends
    cdef list _ways
    cdef object _beside
    cdef double[::1] _along
    cdef double _x, _y, _end
    cdef Py_ssize_t _row

    @cython.locals(vehicle=Body, body=Body)
    cpdef void control(self) except *

    @cython.locals(bends=Bends, has_ended=bint, count=Py_ssize_t, first=Py_ssize_t, number=Py_ssize_t, vehicle=Body,
                   body=Body, way=Track, along=double, ego=Body)
    cpdef void see(self, double[::1] record, Py_ssize_t row) except *

    cdef double along(self, Py_ssize_t number) except? -1

    cdef Track way(self, Py_ssize_t number)

    @cython.locals(bends=Bends, near=double, is_on=bint)
    cdef bint is_on_way(self, Track way, double x, double y, double heading, double along) except -1

    cdef int _on_own_way(self, Body vehicle, Body body, Track way, Py_ssize_t number) except -2

    @cython.locals(bends=Bends, track="double[::1]", row=Py_ssize_t)
    cdef void _note(self, Py_ssize_t number) except *
