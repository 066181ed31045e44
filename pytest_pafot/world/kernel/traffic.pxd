cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.idm cimport GoalVehicle
from pytest_pafot.world.kernel.lanes cimport Lanes

cdef class TrafficVehicle(GoalVehicle):
    cdef public bint checks, crashed
    cdef double _taken_for, _push_x, _push_y, _diagonal, _next_x, _next_y, _next_heading, _next_speed
    cdef bint _has_goal, _drives_itself, _is_led, _is_pushed

    cpdef void begin(self, int goal, double wanted, double timer)
    cpdef void lead(self, double x, double y, double heading, double speed)
    cpdef void act(self, list others) except *
    cpdef void step(self, double dt) except *
    cdef void _push(self, double x, double y)

    @cython.locals(other=TrafficVehicle)
    cdef void _choose_lane(self, list others) except *

    @cython.locals(other=TrafficVehicle)
    cdef double _liked(self, Body vehicle) except? -1

cdef class OrdinaryTraffic:
    cdef readonly int tick
    cdef list _vehicles
    cdef object _record
    cdef double _dt
    cdef Py_ssize_t _row, _columns

    @cython.locals(vehicle=TrafficVehicle, other=TrafficVehicle, ego=TrafficVehicle, dt=double, count=Py_ssize_t,
                   index=Py_ssize_t, other_index=Py_ssize_t, vehicles=list)
    cpdef bint step(self) except -1

    @cython.locals(vehicle=TrafficVehicle, row=Py_ssize_t, columns=Py_ssize_t, record="double[::1]")
    cdef void _note(self) except *

@cython.locals(dx=double, dy=double, cos_a=double, sin_a=double, cos_b=double, sin_b=double, moved_x=double,
               moved_y=double, intersecting=bint, will_intersect=bint, least=double, push_x=double, push_y=double,
               side=int, turn=int, nx=double, ny=double, half_a=double, half_b=double, centre=double, moved=double,
               low=double, high=double, apart=double)
cdef void _meet(TrafficVehicle a, TrafficVehicle b, double dt) except *
