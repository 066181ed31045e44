cimport cython
from pytest_pafot.world.kernel.action cimport (
    acceleration_to_speed, checked_si_action, possible_acceleration, possible_steering, without_reversing,
)
from pytest_pafot.world.kernel.bodies cimport Body, overlap
from pytest_pafot.world.kernel.director cimport Director
from pytest_pafot.world.kernel.driver cimport LaneTracker
from pytest_pafot.world.kernel.idm cimport IdmEgo
from pytest_pafot.world.kernel.lanes cimport Lanes
from pytest_pafot.world.kernel.observation cimport Observer

cdef class Pilot:
    cdef readonly int every

    cpdef decide(self, int tick)
    cpdef void actuate(self) except *

cdef class SelfPilot(Pilot):
    cdef IdmEgo ego
    cdef list others

    cpdef void actuate(self) except *

cdef class GivenPilot(Pilot):
    cdef readonly list actions
    cdef readonly double slowest
    cdef Body _ego
    cdef Lanes _lanes
    cdef int _lane
    cdef LaneTracker _tracker
    cdef double _dt, _wanted, _speed, _most, _jerk

    @cython.locals(acceleration=double, steering=double, ego=Body)
    cpdef take(self, action, double seconds)

    @cython.locals(ego=Body, offset=double)
    cpdef void actuate(self) except *

cdef class PlannerPilot(GivenPilot):
    cdef object _ads, _guard, _clock
    cdef Observer _observer
    cdef tuple _decisions
    cdef Py_ssize_t _given
    cdef double _until

    @cython.locals(started=double, seconds=double, taken=Py_ssize_t)
    cpdef decide(self, int tick)

@cython.final
cdef class Loop:
    cdef readonly int tick
    cdef readonly bint ego_touched, npcs_touched
    cdef Body _ego
    cdef Director _director
    cdef Lanes _lanes
    cdef double[::1] _record
    cdef double _dt, _reach
    cdef Py_ssize_t _row, _columns
    cdef list _bodies

    @cython.locals(due=int, body=Body)
    cpdef run(self, Pilot pilot, int ticks)

    @cython.locals(body=Body, row=Py_ssize_t, columns=Py_ssize_t, record="double[::1]", lanes=Lanes)
    cdef void _note(self) except *

    @cython.locals(record="double[::1]", columns=Py_ssize_t, reach=double, first=Py_ssize_t, second=Py_ssize_t,
                   count=Py_ssize_t, start=Py_ssize_t, x=double, is_near=bint)
    cdef bint _contact(self) except -1
