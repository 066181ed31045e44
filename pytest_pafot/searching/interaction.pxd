cimport cython
from libc cimport math

@cython.final
cdef class InteractionSweep:
    cdef readonly bint interacted
    cdef readonly Py_ssize_t alone
    cdef const double[:, :, ::1] _states
    cdef const double[:, ::1] _sizes
    cdef double _headway, _gap, _far

    @cython.locals(tick=Py_ssize_t, vehicle=Py_ssize_t, behind=Py_ssize_t, cos=double, sin=double, offset_x=double,
                   offset_y=double, ahead=double)
    cdef void _look(self, Py_ssize_t ticks, Py_ssize_t vehicles) noexcept

    @cython.locals(room=double)
    cdef bint _is_near(self, Py_ssize_t tick, Py_ssize_t vehicle, double ahead) noexcept
