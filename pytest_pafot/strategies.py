"""Hypothesis strategies for valid chromosomes and scenarios.

Examples are valid by construction, so hypothesis need not filter them. They shrink towards few NPCs,
Position-Instructions, short chains, NPCs that stay in their cells, and low round speeds.

    from hypothesis import given
    import pytest_pafot as pafot

    @given(scenario=pafot.strategies.scenarios())
    def test_never_collides(scenario, pafot_simulate): ...
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from pytest_pafot.model.instructions import (
    SHIFTS,
    SPEED_STEPS_PER_MPS,
    Cell,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import (
    EGO_SPEED,
    GENE_SECONDS,
    PAPER_SPEED_LIMIT,
    Chromosome,
    Scenario,
)
from pytest_pafot.model.vehicle_type import (
    CAR,
    STYLES,
    Style,
    VehicleName,
    VehicleType,
    named_vehicles,
)

if TYPE_CHECKING:
    from pytest_pafot.algorithms.space import Instructions


def _register() -> None:
    # Hypothesis calls this function when it is imported, possibly by the import below. So it is defined before that.
    from hypothesis import strategies  # noqa: PLC0415

    strategies.register_type_strategy(Scenario, lambda _: scenarios())


from hypothesis import strategies as st  # noqa: E402
from hypothesis.strategies import SearchStrategy  # noqa: E402

__all__ = ["chromosomes", "scenarios"]


def __dir__() -> list[str]:
    return __all__


def chromosomes(
    *,
    cells: Iterable[int] = tuple(Cell),
    min_speed: float = 0.0,
    max_speed: float = PAPER_SPEED_LIMIT,
    min_genes: int = 1,
    max_genes: int = 6,
    instructions: Instructions = "cells",
) -> SearchStrategy[Chromosome]:
    """Return a strategy for the chain of one NPC.

    Each cell equals the previous cell or is next to it on the ring.

    Args:
        cells: cells that the chain may visit.
        min_speed, max_speed: bounds on the target speeds [m/s].
        min_genes, max_genes: bounds on the number of genes.
        instructions: ``"cells"`` for Position-Instructions, ``"lanes"`` for Lane-Instructions, ``"both"`` for either
            kind.

    Raises:
        ValueError: if no chain is within the bounds.
    """
    allowed = _cells(cells)
    speeds = _speeds(min_speed, max_speed)
    lengths = _bounds("genes", min_genes, max_genes)
    in_lanes = _in_lanes(instructions, speeds, min_genes, max_genes)

    @st.composite
    def build(draw: st.DrawFn) -> Chromosome:
        return _chains(
            draw,
            1,
            draw(lengths),
            starts=allowed,
            allowed=allowed,
            speeds=speeds,
            in_lanes=in_lanes,
        )[0]

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
    traffic: Style = "hostile",
    instructions: Instructions = "both",
    vehicles: Iterable[VehicleName | VehicleType] = (CAR,),
) -> SearchStrategy[Scenario]:
    """Return a strategy for complete scenarios on a straight road. NPCs never share a cell at the same time.

    Args:
        cells: cells that chains of Position-Instructions may visit.
        min_speed, max_speed: bounds on the target speeds [m/s].
        min_genes, max_genes: bounds on the number of genes; all chains of Position-Instructions have the same length.
        min_npcs, max_npcs: bounds on the number of NPCs, from 1 to 8.
        lanes: number of lanes of the road.
        ego_lane: initial lane of the ego, 0 at the left; None for a random one.
        ego_speed: initial speed of all vehicles [m/s].
        gene_seconds: duration of a gene [s].
        traffic: driving style of the NPCs, which can raise the lower bound of the target speeds.
        instructions: ``"cells"``, ``"lanes"``, or ``"both"`` for either kind in each NPC.
        vehicles: vehicle types of the NPCs, as objects or names of built-in types. Examples shrink to the first one.

    Raises:
        ValueError: if no scenario is within the bounds.
    """
    kinds = named_vehicles(tuple(vehicles))
    if traffic not in STYLES:
        raise ValueError(f"traffic: expected one of {', '.join(STYLES)}, received {traffic!r:.100}")
    allowed = _cells(cells)
    speeds = _speeds(max(min_speed, STYLES[traffic].least_speed(max_speed)), max_speed)
    lengths = _bounds("genes", min_genes, max_genes)
    counts = _bounds("npcs", min_npcs, max_npcs, 8)
    in_lanes = _in_lanes(instructions, speeds, min_genes, max_genes)
    if lanes < 1:
        raise ValueError(f"lanes: expected at least 1, received {lanes}")
    if ego_lane is not None and not 0 <= ego_lane < lanes:
        raise ValueError(f"ego_lane: expected a lane from 0 to {lanes - 1}, received {ego_lane}")
    starts = {
        lane: [cell for cell in allowed if 0 <= lane + cell.column < lanes] for lane in range(lanes)
    }
    # Examples shrink to the first lane of the list, which should be the one next to the leftmost.
    ordered = sorted(range(lanes), key=lambda lane: (lane != min(1, lanes - 1), lane))
    usable = [
        lane for lane in ordered if ego_lane in (None, lane) and len(starts[lane]) >= max_npcs
    ]
    if not usable:
        raise ValueError(
            f"max_npcs: expected at most one NPC for each cell on the road, received {max_npcs} NPCs for the cells "
            f"{[int(cell) for cell in allowed]} on {lanes} lanes. Use fewer NPCs, more cells or more lanes"
        )

    @st.composite
    def build(draw: st.DrawFn) -> Scenario:
        lane = draw(st.sampled_from(usable))
        npcs = _chains(
            draw,
            draw(counts),
            draw(lengths),
            starts=starts[lane],
            allowed=allowed,
            speeds=speeds,
            in_lanes=in_lanes,
        )
        seed = draw(st.integers(0, 2**16 - 1))
        vehicles = kinds * len(npcs)
        if len(kinds) > 1:
            vehicles = tuple(draw(st.sampled_from(kinds)) for _ in npcs)
        return Scenario(
            npcs=npcs,
            seed=seed,
            ego_lane=lane,
            ego_speed=ego_speed,
            gene_seconds=gene_seconds,
            traffic=traffic,
            vehicles=vehicles,
        )

    return build()


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
    # This is a function and not a strategy, because hypothesis reads the source of each new strategy, which would be
    # slow at each draw. Chains in lanes are drawn first, so that hypothesis can omit any other NPC when it shrinks an
    # example.
    held: list[Cell] = []
    lanes = [draw(in_lanes) for _ in range(npcs)]
    on_grid = lanes.count(None)
    for _ in range(on_grid):
        held.append(draw(st.sampled_from([cell for cell in starts if cell not in held])))
    rows = [list(held)]
    for _ in range(genes - 1):
        # The NPCs move to free cells one after another, so that "stay" is always possible. The order decides which NPC
        # can follow another one along the ring.
        order = list(range(on_grid))
        if on_grid >= 2 and draw(st.booleans()):
            order.reverse()
        for npc in order:
            free = [cell for cell in held[npc].neighbours if cell in allowed and cell not in held]
            moves = [held[npc], *free]
            held[npc] = draw(st.sampled_from(moves))
        rows.append(list(held))
    columns = zip(*rows, strict=True)
    return tuple(
        chain or tuple(PositionInstruction(cell, draw(speeds)) for cell in next(columns))
        for chain in lanes
    )


def _in_lanes(
    instructions: str,
    speeds: SearchStrategy[float],
    min_genes: int,
    max_genes: int,
) -> SearchStrategy[Chromosome | None]:
    # None means an NPC with Position-Instructions, towards which examples shrink.
    gene = st.builds(LaneInstruction, st.sampled_from(SHIFTS), speeds)
    chain = st.lists(gene, min_size=min_genes, max_size=max_genes).map(tuple)
    kinds = {"cells": st.none(), "lanes": chain, "both": st.none() | chain}
    if instructions not in kinds:
        raise ValueError(
            f"instructions: expected one of {', '.join(kinds)}, received {instructions!r:.100}"
        )
    return kinds[instructions]


def _speeds(low: float, high: float) -> SearchStrategy[float]:
    first = round(low * SPEED_STEPS_PER_MPS)
    last = round(high * SPEED_STEPS_PER_MPS)
    if not 0 <= first <= last:
        raise ValueError(
            f"min_speed, max_speed: expected 0 <= min_speed <= max_speed, received {low!r} and {high!r}"
        )

    def speed(step: int, exact: bool) -> float:
        whole = -(-step // SPEED_STEPS_PER_MPS) * SPEED_STEPS_PER_MPS
        if not exact and whole <= last:
            step = whole
        return step / SPEED_STEPS_PER_MPS

    # all examples shrink to round speeds
    return st.builds(speed, st.integers(first, last), st.booleans())


def _cells(cells: Iterable[int]) -> list[Cell]:
    chosen = sorted({Cell(cell) for cell in cells})
    if not chosen:
        raise ValueError("cells: expected at least one cell from 1 to 8, received none")
    return chosen


def _bounds(name: str, low: int, high: int, most: int | None = None) -> SearchStrategy[int]:
    if not 1 <= low <= high or (most is not None and high > most):
        expected = f"1 <= min_{name} <= max_{name}"
        if most is not None:
            expected = f"{expected} <= {most}"
        raise ValueError(
            f"min_{name}, max_{name}: expected {expected}, received {low!r} and {high!r}"
        )
    return st.integers(low, high)
