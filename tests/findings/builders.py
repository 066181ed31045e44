"""Findings for tests: a plain one, and a strategy for nasty ones."""

from dataclasses import replace
from functools import cache
from typing import get_args

from hypothesis import strategies as st

from pytest_pafot.attribution.responsibility import LANE_CHANGES, Manoeuvre
from pytest_pafot.corpus.reader import LIMITS, WORLDS
from pytest_pafot.findings.finding import (
    MAX_KEY,
    MAX_NUMBER,
    Bounded,
    Expect,
    FailureRate,
    Finding,
    Found,
)
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.findings.sighting import (
    Alike,
    Beyond,
    Discovery,
    Judged,
    NotFound,
    Replay,
    Seen,
    Shows,
    Try,
    Which,
)
from pytest_pafot.findings.situation import Situation, ZoneSituation
from pytest_pafot.findings.verdict import ZONES, Verdict
from pytest_pafot.model.instructions import (
    ACTS,
    SHIFTS,
    Cell,
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import MAX_SEED, Scenario
from pytest_pafot.model.sight import NOISES, Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.model.vehicle_type import READY, STYLES
from pytest_pafot.world import Highway
from tests.helpers.hostile import CHARACTERS

VERSIONS = {"pytest-pafot": "0.1.0", "highway-env": "1.12.1", "numpy": "2.4.6"}

NASTY_TEXTS = [
    "yes", "No", "null", "~", "true", "1.0", "1e3", "0x1F", "012", "1:30", "2026-11-20", ".inf", ".nan", "<<", "=",
    "a: b", "a #b", "#", "- a", "? a", "[a, b]", "{a: b}", "&a", "*a", "!a", "|", ">", "%a", "@a", "`a`", "'a'", '"a"',
    "it's", "a\\n", "\\", " a", "a ", "a\tb", "\t", "\n", "a\nb", "a\nb\n", "a\nb\n\n", "\na", " a\nb", "a\n b\n  c\n",
    "a\n\n\nb", "a\n   \nb\n", "a\r\nb", "a\rb", "a\x85b", "a\u2028b\n", "\ufeffa", "\x00", "\x1b[31m", "\x7f",
    "na\u00efve", "\U0001f697", "---", "...", "--- a", "a\n---\nb\n", "a\n# b\n", "trailing:", "::", "x" * 3000, "k: |",
]  # fmt: skip


def plain_finding(**changes):
    chain = [PositionInstruction(Cell(1), 25.0), PositionInstruction(Cell(2), 8.0)]
    fields = {
        "id": "front-2-1f3a9c",
        "test": "tests/test_safety.py::test_never_at_fault_in_a_collision",
        "world": Highway().to_dict(),
        "scenario": Scenario(npcs=(tuple(chain),), seed=7),
        "expect": Expect(
            failure="AssertionError",
            assertion="not run.collision",
            outcome=Outcome.COLLISION,
            time=12.4,
            npc=0,
            cell=Cell.FRONT,
            side="front",
            responsibility="ego",
            takeover=1.25,
        ),
        "found": Found(seed=1234, generation=17, algorithm="pafot", versions=VERSIONS),
    }
    return Finding(**(fields | changes))


def sighting(id_="front-2-1f3a9c", *, finding=None, responsible=None, label="new", **seen):
    """Return what a session saw of a plain finding, or of one with these fields.

    ``label`` is that of a new finding, or a key of :data:`REPLAYS`. More facts of a replay can be given by name.
    """
    made = plain_finding(id=id_, **finding or {})
    if responsible is not None:
        made = replace(made, expect=replace(made.expect, responsibility=responsible))
    alike, severity = Alike(runs=seen.pop("repeats", 0)), seen.pop("severity", None)
    if label in REPLAYS:
        facts = {name: seen.pop(name) for name in list(seen) if name in FACTS}
        observed = replay_of(REPLAYS[label], severity=severity, **facts)
    else:
        observed = Discovery(label=label, ended=judged(Shows.SAME), severity=severity)
    return Seen(finding=made, observed=observed, **{"node_id": f"t[{id_}]", "alike": alike} | seen)


def judged(shows, severity=None):
    failed = shows not in (Shows.HANDLED, Shows.NOTHING, Shows.STILL_COLLIDES)
    return Judged(verdict=Verdict(kind="failed" if failed else "passed", severity=severity))


def tried(shows, which=Which.AS_SAVED, *, ended=None, repeats=True, severity=None):
    """Return a run of a replay that shows this, by default one to the end of the file."""
    ended = ended or judged(shows, severity)
    return Try(which=which, ended=ended, shows=shows, repeats=repeats)


def measured(rate):
    """Return the ten runs of a replay whose file has a rate."""
    shown = [Shows.OTHER] * rate.failing + [Shows.HANDLED] * (rate.runs - rate.failing)
    return tuple(tried(each, Which.REPEATED) for each in shown)


FACTS = ("before", "reference_passes", "rate", "beyond", "searched", "against")


def replay_of(
    known, *, severity=None, before=None, reference_passes=None, rate=None, beyond="", searched=0, against=""
):  # fmt: skip
    """Return a replay with more facts than the known ones."""
    now = replace(known, against=against)
    if severity is not None:
        first = replace(known.tries[0], ended=judged(known.tries[0].shows, severity))
        now = replace(now, tries=(first, *known.tries[1:]))
    if reference_passes is not None:
        shows = Shows.HANDLED if reference_passes else Shows.OTHER
        now = replace(now, reference=(tried(shows, severity=before),))
    if rate is not None:
        now = replace(now, tries=(*now.tries, *measured(rate)))
    if beyond:
        now = replace(now, acceptance=Beyond(why=beyond))
    if searched:
        now = replace(now, search=NotFound(runs=searched, drawn=0))
    return now


PASS, FAILURE = Replay(tries=(tried(Shows.HANDLED),)), Replay(tries=(tried(Shows.SAME),))
REPLAYS = {
    "accepted": replace(FAILURE, acceptance="accepted"),
    "still failing": FAILURE,
    "introduced": replay_of(FAILURE, reference_passes=True),
    "drifted": Replay(tries=(tried(Shows.NOTHING),)),
    "passes": PASS,
    "fixed": replay_of(PASS, searched=40),
}
"""Replays with these labels."""


@cache  # hypothesis then examines a strategy only once
def texts(min_size=0):
    nasty = st.sampled_from([text for text in NASTY_TEXTS if len(text) >= min_size])
    printable = st.text(CHARACTERS, min_size=min_size, max_size=60)
    return st.one_of(
        nasty, printable, st.text("ab :#-'\"\n\t{[,]}&*!|>%@", min_size=min_size, max_size=30)
    )


@cache
def keys():
    return texts().filter(lambda text: len(text) <= MAX_KEY)


@cache
def plain_data():
    floats = st.floats(allow_nan=False)
    scalars = st.one_of(st.none(), st.booleans(), st.integers(-(10**30), 10**30), floats, texts())
    return st.recursive(
        scalars,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4), st.dictionaries(keys(), inner, max_size=4)
        ),
        max_leaves=12,
    )


@cache
def plain_worlds():
    """Return complete worlds of this package as a file may contain them, with any values."""

    def world(kind, keys):
        numbers = st.fixed_dictionaries(dict.fromkeys(LIMITS.required, st.floats(allow_nan=False)))
        values = {key: numbers if key == "limits" else plain_data() for key in keys.required}
        return st.fixed_dictionaries({**values, "kind": st.just(kind)})

    return st.one_of([world(kind, keys) for kind, keys in WORLDS.items()])


@cache
def any_worlds():
    return st.one_of(st.dictionaries(keys(), plain_data(), max_size=5), plain_worlds())


def crossing_instructions():
    names = st.text("abcXYZ0123456789_.-", min_size=1, max_size=30)
    return st.builds(
        CrossingInstruction,
        st.just("o1>o3") | st.tuples(names, names).map(">".join),
        st.integers(-50, 50).map(lambda tenths: tenths / 10),
        st.integers(1, 268).map(lambda tenths: tenths / 10),
        st.sampled_from(ACTS),
    )


@st.composite
def scenarios(draw):
    speeds = st.integers(0, 268).map(lambda tenths: tenths / 10)
    cells = st.builds(PositionInstruction, st.integers(1, 8), speeds)
    lanes = st.builds(LaneInstruction, st.sampled_from(SHIFTS), speeds)
    chain = st.one_of(
        st.lists(cells, min_size=1, max_size=8),
        st.lists(lanes, min_size=1, max_size=8),
        crossing_instructions().map(lambda each: [each]),
    )
    chains = draw(st.lists(chain, min_size=1, max_size=4))
    return Scenario.repaired(
        chains,
        seed=draw(st.integers(0, MAX_SEED)),
        ego_lane=draw(st.integers(0, 9)),
        ego_speed=draw(st.floats(0, 1e3)),
        gene_seconds=draw(st.one_of(st.just(10.0), st.floats(1e-7, 1e3))),
        traffic=draw(st.sampled_from(sorted(STYLES))),
        vehicles=draw(st.lists(st.sampled_from(sorted(READY)), max_size=len(chains))),
    )


@st.composite
def expectations(draw, npcs):
    outcome = draw(
        st.sampled_from([outcome for outcome in Outcome if outcome is not Outcome.INVALID])
    )
    is_collision = outcome is Outcome.COLLISION
    some = st.just if is_collision else lambda value: st.one_of(st.none(), st.just(value))
    zone = draw(st.none() | st.sampled_from(ZONES))
    return Expect(
        failure=draw(texts(min_size=1).filter(str.strip)),
        assertion=draw(texts()),
        check=draw(st.none() | bounded()),
        message=draw(texts()),
        outcome=outcome,
        time=draw(st.floats(0, 1e6)),
        npc=draw(some(draw(st.integers(0, npcs - 1)))),
        cell=draw(some(draw(st.sampled_from(Cell))))
        if zone is None
        else draw(st.none() | st.sampled_from(Cell)),
        zone=zone,
        side=draw(some(draw(st.sampled_from(["front", "rear", "left", "right"])))),
        closing_speed=draw(st.none() | st.floats(0, MAX_NUMBER)),
        situation=draw(st.none() | situations(npcs)),
        responsibility=draw(st.sampled_from(["ego", "npc", "both", "none"])),
        **draw(
            st.sampled_from(
                [{}, *({"fault": "entered-lane", "mistake": each} for each in LANE_CHANGES)]
            )
        ),
        npc_manoeuvre=draw(st.sampled_from([None, *get_args(Manoeuvre)])),
        ego_manoeuvre=draw(st.sampled_from([None, *get_args(Manoeuvre)])),
        takeover=draw(st.none() | st.floats(0, 3)),
        against=draw(texts()),
        traceback=draw(texts()),
    )


def situations(npcs):
    numbers = st.floats(-MAX_NUMBER, MAX_NUMBER)
    both = {
        "npc": st.integers(0, npcs - 1),
        "time": st.floats(0, 1e6),
        "ego_speed": numbers,
        "npc_speed": numbers,
    }
    places = {
        "gap": numbers,
        "place": st.sampled_from(["ahead", "behind"]),
        "lanes_to_right": st.integers(-5, 5),
    }
    on_grid = st.builds(Situation, **both, **places)
    return on_grid | st.builds(ZoneSituation, **both, npc_enters=numbers, ego_enters=numbers)


def bounded():
    numbers = st.none() | st.floats(-MAX_NUMBER, MAX_NUMBER)
    return st.builds(
        Bounded,
        value=numbers,
        at_most=st.floats(-MAX_NUMBER, MAX_NUMBER),
        at_least=numbers,
        unit=texts(),
    )


def simplifications():
    return st.builds(
        Shrunk, rollouts=st.integers(0, 10**6), is_minimal=st.booleans(), before=texts()
    )


def rates():
    return st.integers(1, 1000).flatmap(
        lambda runs: st.builds(FailureRate, failing=st.integers(0, runs), runs=st.just(runs))
    )


@st.composite
def perceptions(draw):
    numbers = st.floats(0, 1e6)
    return Sight(
        range=draw(st.none() | numbers),
        latency=draw(numbers),
        noise=draw(st.dictionaries(st.sampled_from(sorted(NOISES)), numbers)),
        dropout=draw(st.floats(0, 1)),
    )


@st.composite
def findings(draw):
    scenario = draw(scenarios())
    reason = draw(st.one_of(st.none(), texts(min_size=1).filter(str.strip)))
    until = None if reason is None else draw(st.dates())
    return Finding(
        id=draw(st.sampled_from(["front-2-1f3a9c", "a", "A_b.c-d"])),
        test=draw(texts(min_size=1).filter(str.strip)),
        scenario=scenario,
        world=draw(any_worlds()),
        expect=draw(expectations(len(scenario.npcs))),
        found=Found(
            seed=draw(st.integers(0, 10**40)),
            generation=draw(st.integers(0, 10**6)),
            algorithm=draw(texts()),
            policy=draw(st.none() | texts()),
            worst_closing_speed=draw(st.none() | st.floats(0, MAX_NUMBER)),
            versions=draw(st.dictionaries(keys(), texts(), max_size=4)),
        ),
        perception=draw(st.none() | perceptions()),
        shrunk=draw(st.one_of(st.none(), simplifications())),
        rate=draw(st.none() | rates()),
        flaky=draw(st.one_of(st.none(), texts(min_size=1).filter(str.strip))),
        xfail=reason,
        xfail_until=until,
    )
