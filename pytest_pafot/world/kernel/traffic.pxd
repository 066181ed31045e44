cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Body
from pytest_pafot.world.kernel.idm cimport GoalVehicle
from pytest_pafot.world.kernel.network_vehicle cimport StaticObstacle
from pytest_pafot.world.kernel.road_rules cimport RoadRules

cdef class OrdinaryTraffic:
    cdef public list vehicles
    cdef list _obstacles
    cdef object _record
    cdef RoadRules _rules
    cdef double _dt
    cdef Py_ssize_t _row, _columns

    @cython.locals(vehicle=GoalVehicle, other=GoalVehicle, obstacle=StaticObstacle, dt=double, count=Py_ssize_t, index=Py_ssize_t,
                   other_index=Py_ssize_t, vehicles=list, everything=list)
    cpdef void step(self) except *

    @cython.locals(vehicle=GoalVehicle, row=Py_ssize_t, columns=Py_ssize_t, record="double[::1]")
    cdef void _note(self) except *

@cython.locals(shared=double, dx=double, dy=double, cos_a=double, sin_a=double, cos_b=double,
               sin_b=double, moved_x=double, moved_y=double, intersecting=bint, will_intersect=bint, least=double,
               push_x=double, push_y=double, side=int, turn=int, nx=double, ny=double, half_a=double, half_b=double,
               centre=double, moved=double, low=double, high=double, apart=double)
cdef void _meet(GoalVehicle a, Body b, GoalVehicle other, double diagonal, double dt) except *
