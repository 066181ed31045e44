cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bends cimport Bends
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.crossing cimport Crosser, CrossingNpc, LeaderAhead
from pytest_pafot.world.kernel.director cimport BaseDirector, Director, Npc
from pytest_pafot.world.kernel.driver cimport NpcDriver, clear_to_enter, following_speed, gap_speed

cdef double LOOK_AHEAD, HEADING_SHARE, CHANGING_SHARE, BETWEEN_LANES

cdef class NetworkDirector(Director):
    cdef public JunctionDirector others
    cdef Bends _bends
    cdef object _start_cells, _road
    cdef double _width_of_lanes, _jerk, _dt

    cpdef object _first_existing(self)

    cpdef bint _has_lane(self, Npc npc, int lane) except -1

    cpdef object _existing(self, Body ego)

    cpdef double _stretch(self, Body body) except? -1

    @cython.locals(distance=double)
    cdef double _gap(self, Npc front, Npc rear) except? -1

    @cython.locals(goal=int, wanted=double)
    cpdef void _control(self, Npc npc, Body ego) except *

    @cython.locals(asked=double, gained=double, changing=double)
    cdef void _move(self, Npc npc, int goal, double wanted) except *

    @cython.locals(target_lane=int, stretch=double, ego_stretch=double, along=double, target=double, distance=double,
                   shift=int, goal=int, wanted=double, gap=double)
    cdef (int, double) _aim(self, Npc npc, Body ego)

    @cython.locals(wanted=int, side=int, other=int)
    cpdef int _next_lane(self, Npc npc, int target_lane, Body ego) except -2

    @cython.locals(step=int, is_slow_enough=bint, has_room=bint)
    cdef int _step(self, Npc npc, int target_lane, Body ego) except -2

    @cython.locals(rear=double, later=double)
    cdef bint _goes_on(self, int lane, Npc npc) except -1

    @cython.locals(bends=Bends, driver=NpcDriver, direction=double, lean=double, later=double, later_direction=double,
                   later_lean=double)
    cdef _steer(self, Npc npc, int goal)

cdef class JunctionDirector(BaseDirector):
    cdef object _scenario, _junction
    cdef NetworkDirector _grid
    cdef int _ego_lane
    cdef object _limits
    cdef double _top_speed, _dt
    cdef list _crossing, _vehicles, _relations, _numbers
    cdef Crosser _crosser

    cpdef command(self, Body ego)

    @cython.locals(number=int)
    cpdef double ceiling(self, Npc npc) except? -1

    @cython.locals(leader=LeaderAhead, theirs=Body, along=double, front=Body, rear=Body)
    cpdef bint leaves_room(self, Npc npc, int lane) except -1
