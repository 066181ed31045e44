cimport cython
from pytest_pafot.world.kernel.action cimport (
    acceleration_to_speed, checked_si_action, possible_acceleration, possible_steering, without_reversing,
)
from pytest_pafot.world.kernel.lanes cimport Body, Box, Lanes, Places, overlap
from pytest_pafot.world.kernel.director cimport BaseDirector
from pytest_pafot.world.kernel.driver cimport LaneTracker
from pytest_pafot.world.kernel.idm cimport GoalVehicle
from pytest_pafot.world.kernel.observation cimport Sensor
from pytest_pafot.world.kernel.idm cimport EgosRoadRules

cdef class EgoDriver:
    cdef readonly Body ego
    cdef readonly int every
    cdef readonly list actions
    cdef public double slowest

    cpdef decide(self, int tick)
    cpdef actuate(self)
    cpdef step(self, double dt)

cdef class ModelDriver(EgoDriver):
    cdef GoalVehicle model
    cdef list others
    cdef EgosRoadRules rules

    cpdef actuate(self)
    cpdef step(self, double dt)

cdef class GivenDriver(EgoDriver):
    cdef Body _place
    cdef Sensor _sensor
    cdef int _lanes, _lane
    cdef LaneTracker _tracker
    cdef double _lane_width, _dt, _wanted, _speed, _angle, _most, _jerk
    cdef object _kind

    cpdef observe(self, int tick)

    @cython.locals(acceleration=double, steering=double, sensor=Sensor, heading=double)
    cpdef take(self, action, double seconds)

    @cython.locals(ego=Body, across=double, heading=double, offset=double, wanted=double)
    cpdef actuate(self)

    cdef _steer(self, double angle)

cdef class PlannerDriver(GivenDriver):
    cdef object _ads, _guard, _clock
    cdef tuple _decisions
    cdef Py_ssize_t _given
    cdef double _until, _limit

    @cython.locals(started=double, seconds=double)
    cpdef decide(self, int tick)

@cython.final
cdef class Loop:
    cdef readonly int tick
    cdef readonly bint ego_touched, npcs_touched
    cdef Body _ego
    cdef BaseDirector _director
    cdef Places _places
    cdef Lanes _lanes
    cdef double[::1] _record
    cdef double _dt, _reach
    cdef Py_ssize_t _row, _end, _columns
    cdef list _vehicles, _npcs, _obstacles
    cdef public object simulation

    @cython.locals(due=int, body=Body)
    cpdef run(self, EgoDriver driver, int ticks)

    cpdef command(self)

    cpdef bint moved(self) except -1

    @cython.locals(body=Body, row=Py_ssize_t, columns=Py_ssize_t, record="double[::1]", lanes=Lanes)
    cdef _note(self)

    @cython.locals(record="double[::1]", columns=Py_ssize_t, reach=double, first=Py_ssize_t, second=Py_ssize_t,
                   count=Py_ssize_t, start=Py_ssize_t, x=double, is_near=bint, obstacle=Box)
    cdef bint _contact(self) except -1
