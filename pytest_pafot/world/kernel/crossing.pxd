cimport cython
from libc cimport math
from pytest_pafot.world.kernel.lanes cimport Body, Track
from pytest_pafot.world.kernel.director cimport BaseDirector, NetworkDirector, Npc
from pytest_pafot.world.kernel.driver cimport NpcDriver, clear_to_enter, following_speed, gap_speed, speed_for_braking

cdef double STEP, FREEZE, SLOWEST, FASTEST
cdef int PASS, HOLD, STOP, LATE, NEVER
cdef double BEFORE_LINE, MARGIN, SETTING_OFF, RESPONSE, ANSWER, BUILDING_UP, BRAKING, APART, LEAST_SPEED, ABREAST
cdef double UNENDING, NOWHERE

@cython.final
cdef class SharedPlace:
    cdef readonly Py_ssize_t other
    cdef readonly double begins, ends, its_begins, its_ends

@cython.final
cdef class LeaderAhead:
    cdef readonly Py_ssize_t other
    cdef readonly double[::1] places

    @cython.locals(point=Py_ssize_t)
    cpdef double place(self, double along) except? -1

@cython.final
cdef class CrossingNpc(Body):
    cdef public int index
    cdef readonly Track track
    cdef readonly double enters, leaves, ego_enters, ego_leaves, middle, wanted
    cdef readonly int act, entered
    cdef public double slot, begins, entry, asked, course, turning
    cdef readonly NpcDriver driver
    cdef readonly double stands_at
    cdef readonly double[::1] speeds, times
    cdef bint is_frozen, is_released
    cdef int noticed
    cdef public list conflicts, leaders

    @cython.locals(point=Py_ssize_t, most=double)
    cdef void _plan(self) except *

    cpdef double lasts(self, double since, double until) except? -1

cpdef double stopping_speed(double room, double speed) except? -1

cpdef bint can_stop(double room, double speed) except -1

cdef class JunctionDirector(BaseDirector):
    cdef object _scenario, _junction, _limits
    cdef NetworkDirector _grid
    cdef int _ego_lane, _response, _tick
    cdef double _ego_across, _top_speed, _jerk, _dt
    cdef list _crossing, _vehicles, _relations, _numbers

    @cython.locals(npc=CrossingNpc)
    cpdef command(self, Body ego)

    @cython.locals(number=int)
    cpdef double ceiling(self, Npc npc) except? -1

    @cython.locals(leader=LeaderAhead, theirs=Body, closing_speed=double)
    cpdef bint leaves_room(self, Npc npc, int lane) except -1

    @cython.locals(track=Track, fastest=double, wanted=double, room=double, has_passed=bint, is_due=bint, is_late=bint,
                   safe=double, gained=double)
    cdef double _desired_speed(self, CrossingNpc npc, Body ego) except? -1

    cdef double _speed_factor(self, CrossingNpc npc, Body ego) except? -1

    @cython.locals(crossing=double)
    cdef double _time_to_entry(self, CrossingNpc npc, Body ego) except? -1

    cdef bint _reacts(self, CrossingNpc npc, Body ego) except -1

    cdef double _slowness(self, CrossingNpc npc) except? -1

    @cython.locals(npc=CrossingNpc)
    cdef double _time_to(self, Body vehicle, double place) except? -1

    @cython.locals(conflict=SharedPlace, theirs=Body, is_in=bint, comes=double, leaves=double, room=double,
                   can_wait=bint)
    cdef double _giving_way(self, Body mine, int index, list conflicts, double wanted) except? -1

    cdef bint _is_beside(self, Body vehicle) except -1

    @cython.locals(leader=LeaderAhead, theirs=Body)
    cdef double _following(self, Body mine, list leaders, double wanted) except? -1

    @cython.locals(track=Track, course=double)
    cdef void _steer(self, CrossingNpc npc) except *
