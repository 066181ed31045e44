"""Hypothesis strategies for valid instructions, chromosomes and scenarios.

Examples are valid by construction: a chain is a start cell and steps along the ring, so hypothesis need not filter
them. They shrink towards few NPCs, Position-Instructions, short chains, no change of the cell or lane, and low round
speeds; crossing NPCs shrink towards a slot of 0.

    from hypothesis import given
    import pytest_pafot as pafot

    @given(scenario=pafot.strategies.scenarios())
    def test_never_collides(scenario, pafot_simulate): ...
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any

from pytest_pafot.model.driving_style import Traffic
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import (
    BUILT_IN_DRIVERS,
    LARGEST_SLOT,
    MOST_STEPS,
    SHIFTS,
    SLOT_STEPS_PER_SECOND,
    SPEED_STEPS_PER_MPS,
    Act,
    CrossingInstruction,
    Free,
    LaneInstruction,
    Manoeuvre,
    PositionInstruction,
    Recorded,
    Step,
    Track,
    checked_driver,
)
from pytest_pafot.model.scenario import EGO_SPEED, GENE_SECONDS, PAPER_SPEED_LIMIT, Chromosome, Scenario
from pytest_pafot.model.vehicle_type import CAR, VehicleType, named_vehicles


def _register() -> None:
    """Register strategies for instructions, manoeuvres and ``Scenario``, to be inferred from types.

    Hypothesis calls this function when it is imported. The function is defined before the import of hypothesis below,
    because that import may already call it.
    """
    from hypothesis import strategies  # noqa: PLC0415

    strategies.register_type_strategy(PositionInstruction, lambda _: position_instructions())
    strategies.register_type_strategy(LaneInstruction, lambda _: lane_instructions())
    strategies.register_type_strategy(Step, lambda _: steps())
    strategies.register_type_strategy(Manoeuvre, lambda _: manoeuvres())
    strategies.register_type_strategy(Free, lambda _: free_npcs())
    strategies.register_type_strategy(Track, lambda _: tracks())
    strategies.register_type_strategy(Recorded, lambda _: recorded())
    strategies.register_type_strategy(Scenario, lambda _: scenarios())


from hypothesis import strategies as st  # noqa: E402
from hypothesis.strategies import SearchStrategy  # noqa: E402

__all__ = [
    "chromosomes", "free_npcs", "lane_instructions", "manoeuvres", "position_instructions", "recorded", "scenarios",
    "scenarios_in", "steps", "tracks",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


_STEPS = round(LARGEST_SLOT * SLOT_STEPS_PER_SECOND)
_SLOTS = [
    step / SLOT_STEPS_PER_SECOND for step in sorted(range(-_STEPS, _STEPS + 1), key=lambda step: (abs(step), -step))
]
"""All slots, sorted by their absolute value, because examples shrink towards the beginning of a list."""


def position_instructions(
    *, cells: Iterable[int] = tuple(Cell), min_speed: float = 0.0, max_speed: float = PAPER_SPEED_LIMIT
) -> SearchStrategy[PositionInstruction]:
    """Return a strategy for single Position-Instructions, each with a target cell and a target speed.

    Args:
        cells: the cells to choose from, 1 to 8.
        min_speed, max_speed: bounds of the target speed [m/s], rounded to multiples of 0.1.

    Raises:
        ValueError: if a cell is outside 1 to 8, or if no speed is within the bounds.
    """
    return st.builds(PositionInstruction, st.sampled_from(_cells(cells)), _speeds(min_speed, max_speed))


def lane_instructions(
    *, min_speed: float = 0.0, max_speed: float = PAPER_SPEED_LIMIT
) -> SearchStrategy[LaneInstruction]:
    """Return a strategy for single Lane-Instructions, each with keep, left or right and a target speed.

    Args:
        min_speed, max_speed: bounds of the target speed [m/s], rounded to multiples of 0.1.

    Raises:
        ValueError: if no speed is within the bounds.
    """
    return st.builds(LaneInstruction, st.sampled_from(SHIFTS), _speeds(min_speed, max_speed))


def steps(*, min_speed: float = 0.0, max_speed: float = PAPER_SPEED_LIMIT) -> SearchStrategy[Step]:
    """Return a strategy for single steps of a manoeuvre, of any trigger and act.

    Args:
        min_speed, max_speed: bounds of the target speed [m/s], rounded to multiples of 0.1.

    Raises:
        ValueError: if no speed is within the bounds.
    """
    triggers: SearchStrategy[dict[str, float]] = st.one_of(
        st.builds(dict, after=_tenths(0, 50)),
        st.builds(dict, gap=_tenths(-500, 1000)),
        st.builds(dict, headway=_tenths(-20, 50)),
    )
    acts = {"lane": st.sampled_from(SHIFTS), "lateral_speed": _tenths(3, 30), "offset": _tenths(-15, 15)}
    speed = st.none() | _speeds(min_speed, max_speed)
    return st.builds(
        lambda trigger, **act: Step(**trigger, **act), triggers, **acts, speed=speed, acceleration=_tenths(5, 80)
    )


def manoeuvres(
    *,
    beside: Iterable[int] = (0, 1, -1),
    max_distance: float = 100.0,
    max_steps: int = 3,
    min_speed: float = 0.0,
    max_speed: float = PAPER_SPEED_LIMIT,
) -> SearchStrategy[Manoeuvre]:
    """Return a strategy for manoeuvres. Whether their lanes exist depends on the ego's lane and the world.

    Args:
        beside: the first lanes to choose from, as numbers of lanes to the right of the ego's.
        max_distance: the largest distance at the start [m].
        max_steps: the largest number of steps.
        min_speed, max_speed: bounds of the speeds [m/s], rounded to multiples of 0.1.

    Raises:
        ValueError: if no manoeuvre is within the bounds.
    """
    if not 0 <= max_steps <= MOST_STEPS:
        raise ValueError(f"manoeuvres: expected 0 to {MOST_STEPS} steps, received {max_steps!r}")
    start = _placed("manoeuvres", beside, max_distance, _speeds(min_speed, max_speed))
    chains = st.lists(steps(min_speed=min_speed, max_speed=max_speed), max_size=max_steps).map(tuple)
    return st.builds(Manoeuvre, **start, steps=chains)


def free_npcs(
    *,
    drivers: Iterable[str] = BUILT_IN_DRIVERS,
    beside: Iterable[int] = (0, 1, -1),
    max_distance: float = 100.0,
    min_speed: float = 0.0,
    max_speed: float = PAPER_SPEED_LIMIT,
) -> SearchStrategy[Free]:
    """Return a strategy for free NPCs. Whether their lanes exist depends on the ego's lane and the world.

    Args:
        drivers: the names of the drivers to choose from.
        beside: the first lanes to choose from, as numbers of lanes to the right of the ego's.
        max_distance: the largest distance at the start [m].
        min_speed, max_speed: bounds of the speed at the start [m/s], rounded to multiples of 0.1.

    Raises:
        ValueError: if no free NPC is within the bounds.
    """
    names = [checked_driver(name) for name in drivers]
    if not names:
        raise ValueError("free_npcs: expected at least one driver, received none")
    start = _placed("free_npcs", beside, max_distance, _speeds(min_speed, max_speed))
    return st.builds(Free, **start, driver=st.sampled_from(names))


def _placed(
    name: str, beside: Iterable[int], max_distance: float, speeds: SearchStrategy[float]
) -> dict[str, SearchStrategy[Any]]:
    """Return the strategies for the fields of a start."""
    lanes, most = tuple(beside), round(10 * max_distance)
    if not lanes or most < 10:
        expected = "some lanes and a distance of 1 m or more"
        raise ValueError(f"{name}: expected {expected}, received {lanes!r} and {max_distance!r}")
    distances = (_tenths(10, most) | _tenths(-most, -10)).filter(bool)
    return {"beside": st.sampled_from(lanes), "ahead": distances, "speed": speeds}


def tracks(*, max_seconds: float = 5.0, max_speed: float = PAPER_SPEED_LIMIT) -> SearchStrategy[Track]:
    """Return a strategy for tracks that begin within 100 m and two lanes of the ego, with a steady change of speed.

    Args:
        max_seconds: the longest duration [s].
        max_speed: the highest speed [m/s].
    """

    def track(rate: int, rows: int, along: float, across: float, aside: float, ends: tuple[float, float]) -> Track:
        begin, end = ends
        speeds = [begin + (end - begin) * row / (rows - 1) for row in range(rows)]
        places = accumulate([along, *(speed / rate for speed in speeds[:-1])])
        lines = [f"{x} {across + aside * row / rows} 0 {speeds[row]}" for row, x in enumerate(places)]
        return Track("\n".join([f"rate {rate}", *lines]))

    speeds = _tenths(0, round(10 * max_speed))
    rows, rates = st.integers(2, round(max_seconds * 10) + 1), st.integers(10, 15)
    return st.builds(
        track, rates, rows, _tenths(-1000, 1000), _tenths(-80, 80), _tenths(-10, 10), st.tuples(speeds, speeds)
    )


def recorded() -> SearchStrategy[Recorded]:
    """Return a strategy for NPCs that drive as recorded, or with changes of the recording."""
    changes = {"later": _tenths(-50, 50), "pace": st.integers(80, 120).map(lambda share: share / 100)}
    chains = st.lists(steps(), max_size=3).map(tuple)
    return st.builds(Recorded, track=tracks(), **changes, shift=_tenths(-300, 300), steps=chains)


def _tenths(low: int, high: int) -> SearchStrategy[float]:
    return st.integers(low, high).map(lambda number: number / 10)


def chromosomes(
    *,
    cells: Iterable[int] = tuple(Cell),
    min_speed: float = 0.0,
    max_speed: float = PAPER_SPEED_LIMIT,
    min_genes: int = 1,
    max_genes: int = 6,
    instructions: str = "cells",
) -> SearchStrategy[Chromosome]:
    """Return a strategy for one NPC's chain: each cell equals the previous one or is its neighbour on the ring.

    Args:
        cells: the cells that the chain may visit.
        min_speed, max_speed: bounds of the target speeds [m/s].
        min_genes, max_genes: bounds of the number of genes in the chain.
        instructions: ``"cells"`` for Position-Instructions, ``"lanes"`` for Lane-Instructions, ``"both"`` for chains of
            either kind.

    Raises:
        ValueError: if no chain is within the bounds.
    """
    allowed, speeds, lengths = _cells(cells), _speeds(min_speed, max_speed), _bounds("genes", min_genes, max_genes)
    in_lanes = _in_lanes(instructions, speeds, min_genes, max_genes)

    @st.composite
    def build(draw: st.DrawFn) -> Chromosome:
        return _chains(draw, 1, draw(lengths), starts=allowed, allowed=allowed, speeds=speeds, in_lanes=in_lanes)[0]

    return build()


def scenarios(
    *,
    cells: Iterable[int] = tuple(Cell),
    min_speed: float = 0.0,
    max_speed: float = PAPER_SPEED_LIMIT,
    min_genes: int = 1,
    max_genes: int = 6,
    min_npcs: int = 1,
    max_npcs: int = 2,
    lanes: int = 4,
    ego_lane: int | None = None,
    ego_speed: float = EGO_SPEED,
    gene_seconds: float = GENE_SECONDS,
    traffic: str | Traffic = "hostile",
    instructions: str = "both",
    vehicles: Iterable[str | VehicleType] = (CAR,),
) -> SearchStrategy[Scenario]:
    """Return a strategy for whole scenarios on a straight road, in which NPCs never share a cell in the same gene.

    Args:
        cells: the cells that chains of Position-Instructions may visit.
        min_speed, max_speed: bounds of the target speeds [m/s].
        min_genes, max_genes: bounds of the number of genes in a chain; the chains of Position-Instructions in a
            scenario have the same length.
        min_npcs, max_npcs: bounds of the number of NPCs, 1 to 8.
        lanes: the number of lanes of the road; every NPC starts in a cell whose lane exists.
        ego_lane: the ego's first lane, 0 at the left; None for a random one.
        ego_speed: the first speed of all vehicles [m/s].
        gene_seconds: the duration of one gene [s].
        traffic: the driving style of the NPCs, as its name or as a :class:`~pytest_pafot.Traffic`. Target speeds are at
            least its ``least_speed_share`` times ``max_speed``.
        instructions: ``"cells"`` if all NPCs have Position-Instructions, ``"lanes"`` if all have Lane-Instructions,
            ``"both"`` if each NPC has either kind.
        vehicles: what vehicles NPCs can be: names of ready ones, or vehicles. Examples shrink to the first one.

    Raises:
        ValueError: if no scenario is within the bounds.
    """
    kinds = named_vehicles(tuple(vehicles))
    style = Traffic.of(traffic)
    allowed, speeds = _cells(cells), _speeds(max(min_speed, style.least_speed(max_speed)), max_speed)
    lengths, counts = _bounds("genes", min_genes, max_genes), _bounds("npcs", min_npcs, max_npcs, 8)
    in_lanes = _in_lanes(instructions, speeds, min_genes, max_genes)
    if lanes < 1:
        raise ValueError(f"lanes: expected at least 1, received {lanes}")
    if ego_lane is not None and not 0 <= ego_lane < lanes:
        raise ValueError(f"ego_lane: expected a lane from 0 to {lanes - 1}, received {ego_lane}")
    starts = {lane: [cell for cell in allowed if 0 <= lane + cell.column < lanes] for lane in range(lanes)}
    # Examples shrink to the first lane of the list, which should be the one next to the leftmost.
    ordered = sorted(range(lanes), key=lambda lane: (lane != min(1, lanes - 1), lane))
    usable = [lane for lane in ordered if ego_lane in (None, lane) and len(starts[lane]) >= max_npcs]
    if not usable:
        raise ValueError(
            f"max_npcs: expected no more NPCs than cells on the road in which they can start, received {max_npcs} with "
            f"cells {[int(cell) for cell in allowed]} on {lanes} lanes; use fewer NPCs, more cells or more lanes"
        )

    @st.composite
    def build(draw: st.DrawFn) -> Scenario:
        lane = draw(st.sampled_from(usable))
        cells = {"starts": starts[lane], "allowed": allowed}
        npcs = _chains(draw, draw(counts), draw(lengths), **cells, speeds=speeds, in_lanes=in_lanes)
        seed = draw(st.integers(0, 2**16 - 1))
        start: dict[str, Any] = {"ego_lane": lane, "ego_speed": ego_speed, "gene_seconds": gene_seconds}
        return Scenario(npcs=npcs, seed=seed, traffic=style, vehicles=_drawn_kinds(draw, [kinds] * len(npcs)), **start)

    return build()


def scenarios_in(
    world: Any,
    *,
    min_genes: int = 1,
    max_genes: int = 6,
    min_npcs: int = 1,
    max_npcs: int = 2,
    acts: Iterable[Act] | None = None,
    traffic: str | Traffic = "hostile",
    instructions: str | None = None,
    vehicles: Iterable[str | VehicleType] = (CAR,),
) -> SearchStrategy[Scenario]:
    """Return a strategy for whole scenarios that fit a world: its lanes, its speeds, and NPCs on its crossing ways.

    Args:
        world: the world, such as ``pafot.World("intersection-v0")``.
        min_genes, max_genes: bounds of the number of genes in the chain of an NPC that does not cross.
        min_npcs, max_npcs: bounds of the number of NPCs, 1 to 8. If there is no room for a crossing NPC, the scenario
            has fewer NPCs.
        acts: the acts of crossing NPCs to choose from, of ``pass``, ``hold``, ``stop`` and ``late``; by default the
            first three. Only for a world in which NPCs cross.
        traffic: the driving style of the NPCs, as its name or as a :class:`~pytest_pafot.Traffic`.
        instructions: the instructions of NPCs that do not cross, ``"cells"``, ``"lanes"`` or ``"both"``, as for
            :func:`scenarios`; by default both kinds, if the world's NPCs can have Lane-Instructions.
        vehicles: what vehicles NPCs can be, as for :func:`scenarios`. An NPC whose way has bends that none of them can
            follow is a car.

    Raises:
        ValueError: if no scenario is within the bounds, or if the world's NPCs cannot have the instructions.
        WorldError: if the world cannot be built.
    """
    from pytest_pafot.world.guard.own_worlds import base_world  # noqa: PLC0415  (slow to import)

    world, kinds = base_world(world), named_vehicles(tuple(vehicles))
    along = [kind for kind in kinds if world.can_drive(kind)]
    given: dict[str, Any] = {"traffic": traffic, "crossings": world.crossings}
    if acts is not None:
        if given["crossings"] is None:
            raise ValueError(
                f"acts: expected a world in which NPCs cross the ego's way, received {world!r:.100}; leave acts out"
            )
        given["acts"] = tuple(acts)
    has_lanes = world.has_lane_instructions
    if instructions not in (None, "cells") and not has_lanes:
        raise ValueError(
            f"instructions: expected a world whose NPCs can have Lane-Instructions, received {world!r:.100}, which "
            "declares none; leave instructions out, or write has_lane_instructions = True in its class if its NPCs can"
        )
    # Lanes in which the ego can start with enough free cells around it.
    space = world.space(given)
    crossing, starts, room = space.crossing_traffic, _starts(world, space.ego_lane), world.most_on_grid
    usable = [lane for lane, cells in starts.items() if crossing is not None or min(len(cells), room) >= max_npcs]
    if not usable:
        raise ValueError(
            "max_npcs: expected no more NPCs than cells on the road in which they can start, received "
            f"{max_npcs}; use fewer NPCs"
        )
    lengths, counts = _bounds("genes", min_genes, max_genes), _bounds("npcs", min_npcs, max_npcs, 8)
    speeds = _speeds(space.low_step / SPEED_STEPS_PER_MPS, space.top_step / SPEED_STEPS_PER_MPS)
    in_lanes = _in_lanes(instructions or ("both" if has_lanes else "cells"), speeds, min_genes, max_genes)
    ways = (
        []
        if crossing is None
        else [(zone, at) for zone in sorted(crossing.crossings.ways) if (at := crossing.speeds(zone))]
    )

    ways_of = {} if crossing is None else crossing.crossings.ways

    @st.composite
    def build(draw: st.DrawFn) -> Scenario:
        lane, count = draw(st.sampled_from(usable)), draw(counts)
        on_grid = draw(st.integers(0, min(count, room))) if ways else count
        told: list[CrossingInstruction] = []
        for _ in range(count - on_grid):
            zone, at = draw(st.sampled_from(ways))
            speed, act = draw(st.sampled_from(at)), draw(st.sampled_from(space.acts))
            there = (CrossingInstruction(zone, slot, speed, act) for slot in _SLOTS)
            free = [each for each in there if crossing is not None and crossing.has_room(each, told)]
            told += [draw(st.sampled_from(free))] if free else []
        if not told and not on_grid:
            told = [CrossingInstruction(ways[0][0], 0.0, ways[0][1][0])]
        genes = draw(lengths)
        cells = {"starts": starts[lane], "allowed": list(Cell)}
        npcs = _chains(draw, on_grid, genes, **cells, speeds=speeds, in_lanes=in_lanes)
        start: dict[str, Any] = {"ego_lane": lane, "ego_speed": min(space.ego_speed, space.speed_limit)}
        start |= {"gene_seconds": space.gene_seconds, "traffic": space.traffic}
        seed = draw(st.integers(0, 2**16 - 1))
        own = [[kind for kind in kinds if kind.can_follow(ways_of[each.zone].sharpest)] for each in told]
        start["vehicles"] = _drawn_kinds(draw, [*[along] * len(npcs), *own])
        return Scenario(npcs=(*npcs, *((each,) for each in told)), seed=seed, **start)

    return build()


def _drawn_kinds(draw: st.DrawFn, kinds: Iterable[Sequence[VehicleType]]) -> tuple[VehicleType, ...]:
    """Return what vehicle each NPC is, one of its kinds; a car without any. A single kind needs no drawing."""
    return tuple(draw(st.sampled_from(each)) if len(each) > 1 else (*each, CAR)[0] for each in kinds)


def _starts(world: Any, ego_lane: int) -> dict[int, list[Cell]]:
    """Return the cells in which NPCs may start, by the ego's first lane.

    On a road that bends, these are all cells, and the repair replaces the cells that do not exist.
    """
    road = world.straight_road
    if road is None:
        return {ego_lane: list(Cell)}
    lanes = sorted(range(road.lane_count), key=lambda lane: (lane != min(1, road.lane_count - 1), lane))
    return {lane: sorted(road.cells(lane)) for lane in lanes}


def _chains(
    draw: st.DrawFn,
    npcs: int,
    genes: int,
    *,
    starts: list[Cell],
    allowed: list[Cell],
    speeds: SearchStrategy[float],
    in_lanes: SearchStrategy[Chromosome | None],
) -> tuple[Chromosome, ...]:
    """Draw the chains of some NPCs, which start in the cells ``starts`` and stay within the cells ``allowed``.

    If ``in_lanes`` gives a chain for an NPC, the NPC has this chain instead. These chains are drawn first, because
    hypothesis can then leave out any other NPC when it shrinks an example.

    This is a plain function and not a strategy, because hypothesis reads the source of each strategy when the strategy
    is made, which would be slow at each draw.
    """
    held: list[Cell] = []
    lanes = [draw(in_lanes) for _ in range(npcs)]
    on_grid = lanes.count(None)
    for _ in range(on_grid):
        held.append(draw(st.sampled_from([cell for cell in starts if cell not in held])))
    rows = [list(held)]
    for _ in range(genes - 1):
        # One NPC after the other moves to a free cell, so that "stay" is always possible. The order decides which NPC
        # can follow which along the ring.
        order = range(on_grid) if on_grid < 2 or not draw(st.booleans()) else reversed(range(on_grid))
        for npc in order:
            moves = [held[npc], *(c for c in held[npc].neighbours if c in allowed and c not in held)]
            held[npc] = draw(st.sampled_from(moves))
        rows.append(list(held))
    columns = zip(*rows, strict=True)
    return tuple(chain or tuple(PositionInstruction(cell, draw(speeds)) for cell in next(columns)) for chain in lanes)


def _in_lanes(
    instructions: str, speeds: SearchStrategy[float], min_genes: int, max_genes: int
) -> SearchStrategy[Chromosome | None]:
    """Return a strategy for a chain of Lane-Instructions, or None for an NPC on the grid, towards which it shrinks."""
    gene = st.builds(LaneInstruction, st.sampled_from(SHIFTS), speeds)
    chain = st.lists(gene, min_size=min_genes, max_size=max_genes).map(tuple)
    kinds = {"cells": st.none(), "lanes": chain, "both": st.none() | chain}
    if instructions not in kinds:
        raise ValueError(f"instructions: expected one of {', '.join(kinds)}, received {instructions!r:.100}")
    return kinds[instructions]


def _speeds(low: float, high: float) -> SearchStrategy[float]:
    first, last = round(low * SPEED_STEPS_PER_MPS), round(high * SPEED_STEPS_PER_MPS)
    if not 0 <= first <= last:
        raise ValueError(f"min_speed, max_speed: expected 0 <= min_speed <= max_speed, received {low!r} and {high!r}")

    def speed(step: int, exact: bool) -> float:
        whole = -(-step // SPEED_STEPS_PER_MPS) * SPEED_STEPS_PER_MPS
        return (step if exact or whole > last else whole) / SPEED_STEPS_PER_MPS

    return st.builds(speed, st.integers(first, last), st.booleans())  # one shape: all shrink to round speeds


def _cells(cells: Iterable[int]) -> list[Cell]:
    chosen = sorted({Cell(cell) for cell in cells})
    if not chosen:
        raise ValueError("cells: expected at least one cell from 1 to 8, received none")
    return chosen


def _bounds(name: str, low: int, high: int, most: int | None = None) -> SearchStrategy[int]:
    if not 1 <= low <= high or (most is not None and high > most):
        raise ValueError(
            f"min_{name}, max_{name}: expected 1 <= min_{name} <= max_{name}{'' if most is None else f' <= {most}'}, "
            f"received {low!r} and {high!r}"
        )
    return st.integers(low, high)
