cimport cython
from libc cimport math
from pytest_pafot.world.kernel.lanes cimport Bends, Body
from pytest_pafot.world.kernel.driver cimport (
    NpcDriver, clear_to_enter, closing_room, following_gap, following_speed, gap_speed, speed_for_braking,
    stopping_room,
)

cdef double ARRIVED_LATERAL, CREEP_SPEED, BESIDE, TRACK, REACTION, ANSWER, ENTRY_TIME, ENTRY_BRAKING, ENTRY_GAP
cdef double LOOK_AHEAD, HEADING_SHARE, CHANGING_SHARE, BETWEEN_LANES
cdef int NO_LANE, NOT_BEHIND

cdef class Npc(Body):
    cdef public object chain
    cdef public list executed, arrivals
    cdef readonly int index
    cdef public int row, column, kept_lane, shift_lane, heading_for, behind
    cdef public double target, target_speed, kept_speed, asked, course
    cdef public NpcDriver driver
    cdef public object limits
    cdef public double top_speed, half_lengths, longer, lateral
    cdef public Bends bends

cdef class BaseDirector:
    cdef readonly list npcs

    cpdef command(self, Body ego)

    cpdef double ceiling(self, Npc npc) except? -1

    cpdef bint leaves_room(self, Npc npc, int lane) except -1

cdef class Director(BaseDirector):
    cdef public bint skips
    cdef bint _is_mixed
    cdef readonly object _scenario
    cdef object _cells
    cdef readonly list _on_grid, _in_lanes
    cdef readonly double _clearance, _row
    cdef double _lane_width, _far, _aside
    cdef readonly int _tick
    cdef int _last_lane, _genes, _gene_ticks, _gene, _left
    cdef readonly bint _attentive
    cdef double _least_share, _speed_limit, _least_gap, _time_gap, _ample, _easing, _delay
    cdef int _reaction, _kept
    cdef double[::1] _seen

    @cython.locals(npc=Npc)
    cpdef command(self, Body ego)

    @cython.final
    @cython.locals(npc=Npc, gene=int, wanted_lane=int)
    cdef _begin_gene(self, Body ego)

    @cython.final
    @cython.locals(npc=Npc)
    cdef bint _is_led(self, Body ego) except -1

    @cython.final
    @cython.locals(place=int)
    cdef _remember(self, Body ego)

    cpdef double _target(self, Npc npc, Body ego) except? -1

    @cython.final
    cdef double _ahead(self, Body ego) except? -1

    cpdef double _stretch(self, Body body) except? -1

    @cython.locals(least_speed=double, is_in_track=bint, moves_in=bint, sideways=double, has_moved_in=bint, is_led=bint,
                   before=int, place=int, x=double, ego_speed=double, ahead=double, gained=double, braking=double,
                   seconds=double, gap=double, safe=double)
    cpdef double _attending(self, Npc npc, Body ego, double speed) except? -1

    @cython.final
    cdef bint _may_enter(self, Npc npc, Body ego) except -1

    @cython.locals(driver=NpcDriver, goal=int)
    cpdef void _control(self, Npc npc, Body ego) except *

    cpdef double _creeping(self, Npc npc, int goal, double speed) except? -1

    @cython.locals(beside=bint)
    cpdef void _keep_lane_if_due(self, Npc npc, int target_lane, double distance) except *

    cpdef void _keep_shift_lane_if_there(self, Npc npc, double centre) except *

    @cython.locals(lane=int, step=int, other=Npc, beside_ego=bint)
    cpdef int _next_lane(self, Npc npc, int target_lane, Body ego) except -2

    @cython.final
    @cython.locals(front=Npc, rear=Npc, reach=double, in_lane=bint, claims=bint)
    cdef bint _clear_of(self, Npc mine, Npc theirs, int lane) except -1

    cdef double _gap(self, Npc front, Npc rear) except? -1

    @cython.locals(theirs=Npc, distance=double, gap=double, safe=double, aside=double, is_beside=bint, crosses=bint)
    cpdef double _following(self, Npc mine, double speed) except? -1

cdef class NetworkDirector(Director):
    cdef public BaseDirector others
    cdef Bends _bends
    cdef object _start_cells, _road
    cdef double _width_of_lanes, _jerk, _dt

    cpdef double _stretch(self, Body body) except? -1

    cdef double _gap(self, Npc front, Npc rear) except? -1

    @cython.locals(goal=int)
    cpdef void _control(self, Npc npc, Body ego) except *

    cdef void _move(self, Npc npc, int goal, double wanted) except *

    @cython.locals(target_lane=int, shift=int, goal=int, due_lane=int)
    cdef (int, double) _aim(self, Npc npc, Body ego)

    @cython.locals(wanted=int, side=int, other=int)
    cpdef int _next_lane(self, Npc npc, int target_lane, Body ego) except -2

    @cython.locals(is_slow_enough=bint, has_room=bint)
    cdef int _step(self, Npc npc, int target_lane, Body ego) except -2

    cdef bint _goes_on(self, int lane, Npc npc) except -1

    @cython.locals(bends=Bends, driver=NpcDriver)
    cdef _steer(self, Npc npc, int goal)
