cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.lanes cimport Bends, Lanes, Track, even_rounded

cdef double STEP, NOT_ON_WAY, HALF_TURN, NOWHERE
cdef int COLUMNS, TRACK_COLUMNS

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
