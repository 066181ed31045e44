cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.director cimport Director, Npc, TrackedNpc
from pytest_pafot.world.kernel.road_directors cimport NetworkDirector

cdef double APART, ALONG, ACROSS, SECONDS, SAMPLE, ASIDE

cdef class RecordedDirector(Director):
    cdef readonly list _tracked
    cdef double[::1] _ego_track
    cdef double _start, _across

    @cython.locals(npc=TrackedNpc)
    cpdef command(self, Body ego)

    cpdef void _control(self, Npc npc, Body ego) except *

    @cython.final
    @cython.locals(is_own=bint, tracked=TrackedNpc)
    cdef bint _leaves(self, TrackedNpc npc, Body ego) except -1

    @cython.final
    @cython.locals(track="double[::1]", row=int, along=double, across=double)
    cdef bint _is_as_recorded(self, Body ego) except -1

    @cython.final
    @cython.locals(states="double[::1]", along=double, across=double, forward=double, aside=double, last=int, step=int,
                   later=int, tick=int, seconds=double, row=int, beyond=double, distance=double, beside=double)
    cdef bint _nears(self, TrackedNpc npc, Body other) except -1

cdef class RecordedNetworkDirector(NetworkDirector):
    cdef RecordedDirector _watch
    cdef dict _twins

    @cython.locals(watch=RecordedDirector, npc=TrackedNpc, twin=TrackedNpc)
    cpdef command(self, Body ego)

    cpdef void _control(self, Npc npc, Body ego) except *
