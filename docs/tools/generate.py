"""Write the tables of guide/ and reference/ from the docstrings and options in the code.

Run this program after you change the code or the tables: ``python docs/tools/generate.py``.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

from pytest_pafot import policies, properties
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.commands.rate_command import add_arguments as add_rate_arguments
from pytest_pafot.commands.search_command import add_arguments as add_search_arguments
from pytest_pafot.comparison.plan import COLUMNS as COMPARED
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.criticality import RssRules
from pytest_pafot.criticality.signals import MEASURES, EgoLaneChange
from pytest_pafot.findings.finding import Expect, Finding, Found
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.model.instructions import (
    Cell,
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Collision, Outcome
from pytest_pafot.model.vehicle_type import READY, STYLES, DrivingStyle
from pytest_pafot.oracle.run import Run, check
from pytest_pafot.report.session_record import finding_entry
from pytest_pafot.searches import run_table
from pytest_pafot.searches.events import Search
from pytest_pafot.searches.options import BY_NAME, OPTIONS, RUNS, Option
from pytest_pafot.searches.request import Request
from pytest_pafot.world import (
    Highway,
    LaneCommand,
    NpcLimits,
    Observation,
    Perception,
    Simulator,
    SimulatorWorld,
    VehicleState,
    World,
)

DOCS = Path(__file__).parents[1]
REFERENCE = [*sorted(DOCS.glob("reference/*.md")), *sorted(DOCS.glob("guide/*.md"))]

_SECTION = re.compile(r"(<!-- generated: ([a-z-]+) -->\n).*?(<!-- end of generated -->)", re.DOTALL)
_ROLE = re.compile(r":(?:class|func|attr|meth|data|mod):`~?\.?([^`]+)`")
OF_SEARCH = ("traffic", "blame", "runs", "seed", "against")
"""The options of the command ``search`` that are also arguments of the mark."""
_WORLD = re.compile(
    r"drive in this world: the id of a highway-env environment .* a pafot.SimulatorWorld \((.*)",
    re.DOTALL,
)
_ENTRY = re.compile(r"^(\w+(?:, \w+)*): (.*)$")

MARKER_TEXTS: Mapping[str, str] = {
    "ads": 'Policy under test: [its factory](../guide/planners.md), a string such as `"planner:Planner"`, or the name '
    "of a fixture that returns the factory.",
    "world": '[World](worlds.md), such as `pafot.Highway(...)`, or a string such as `"module:factory"`.',
    "blame": 'Failures that count. `"ego"` excludes collisions for which only an NPC is '
    "[responsible](../explanation/verdicts.md).",
    "against": "[Reference policy](../guide/ci.md). Only failures that this policy avoids count.",
    "isolate": "If true, the policy runs in [separate processes](../guide/planners.md). A crash of such a process is a "
    "finding.",
    "traffic": '[Driving style of the NPCs](scenarios.md#traffic-styles): `"hostile"`, `"assertive"`, `"everyday"` or '
    '`"paper"`.',
    "vehicles": "[Vehicle types of the NPCs](scenarios.md#vehicles): names, or `pafot.VehicleType(...)`. If they "
    "include cars, one NPC in six is not a car.",
    "npcs": "Number of NPCs, from 1 to 8.",
    "instructions": '[Instructions](scenarios.md) of NPCs that do not cross the ego\'s path: `"cells"`, `"lanes"` or '
    '`"both"`.',
    "genes": "Number of instructions for each NPC that does not cross the ego's path.",
    "gene_seconds": "Duration of one instruction [s].",
    "ego_lane": "Lane in which the ego starts, counted from 0 at the left.",
    "ego_speed": "Initial speed [m/s] of the ego and of all NPCs that do not cross its path.",
    "runs": "[Number of runs](options.md#pafot-runs), at least 1.",
    "generations": "[Number of generations](options.md#pafot-generations), at least 1. Only some algorithms have "
    "generations.",
    "seed": "[Base seed](options.md#pafot-seed) from which the seed of the search is derived.",
    "algorithm": "[Search algorithm](options.md#pafot-algorithm): a name, or [your own class](../guide/algorithms.md).",
    "fitness": "[Fitness](checks.md#fitness) that the algorithm maximises. The default algorithm does not use it.",
    "shrink_runs": "[Maximum number of runs](options.md#pafot-shrink-runs) for simplifying one finding.",
}
"""Meanings of the mark's arguments."""

MARKER_DEFAULTS: Mapping[str, str] = {
    "ads": '`"ads"`',
    "world": "the fixture `pafot_world`",
    "genes": "as many as fit into the run",
    "npcs": "[sampled](#values-that-you-do-not-set)",
    "gene_seconds": "sampled",
    "traffic": '`"hostile"`; `"paper"` with algorithms from the paper',
    "instructions": '`"both"`; `"cells"` with algorithms from the paper',
    "vehicles": "all types that fit the road; only cars if the `algorithm` is not `random`",
    "ego_lane": "sampled",
    "ego_speed": "sampled",
    "algorithm": '`"random"`',
}
"""Defaults of the mark's arguments that are not in a dataclass."""

MARKER_GROUPS: Mapping[str, Sequence[str]] = {
    "marker-tested": ("ads", "world", "blame", "against", "isolate"),
    "marker-traffic": (
        *(
            "traffic",
            "vehicles",
            "npcs",
            "instructions",
            "genes",
            "gene_seconds",
            "ego_lane",
            "ego_speed",
        ),
    ),
    "marker-search": ("runs", "generations", "seed", "algorithm", "fitness", "shrink_runs"),
}
"""The mark's arguments, by table."""

OPTION_GROUPS: Mapping[str, Sequence[str]] = {
    "options-search": (
        *("runs", "generations", "max_time", "stop_after", "seed", "algorithm", "against"),
        *("workers", "dask", "isolate"),
    ),
    "options-findings": ("shrink_runs", "corpus", "save", "report", "json", "debug"),
    "options-strictness": ("strict_drift", "strict_health", "allow_orphans", "today"),
}
"""The options, by table."""

RUN_GROUPS: Mapping[str, Sequence[str]] = {
    "run-end": ("outcome", "collision", "off_road", "ads_error", "duration", "max_decision_time"),
    "run-danger": (*("min_distance", "min_ttc", "hardest_brake", "closest_approach", "worst_ttc"),),
    "run-verdict": ("responsibility", "explain()", "takeover"),
    "run-ticks": (
        *(
            "ego",
            "npcs",
            "headway",
            "leader",
            "lane_changes",
            "passages",
            "signal()",
            "to_pandas()",
        ),
        *("trace", "scenario"),
    ),
}
"""The attributes of a run, by table. The Python API also lists attributes that only reports and summaries use."""

SEARCH_KEYS = ("node_id", "base_seed, seed", "kinds, outcomes, responsibilities", "finds")
FINDING_KEYS = ("id", "test", "status", "result", "file", "replay", "headline", "detail", "xfail")
"""The keys of --pafot-json that most programs need. The Python API lists all keys."""

FILE_TEXTS: Mapping[str, str] = {
    "pafot": "Version of the file format, `3`.",
    "scenario.seed": "Seed of the package's random choices in the run.",
    "scenario.ego": "Start of the ego: its `lane`, counted from 0 at the left, and its `speed` [m/s]. NPCs that do not "
    "cross the ego's path start at the same speed.",
    "scenario.gene_seconds": "Duration of each instruction [s]. The default is `10.0`.",
    "scenario.traffic": "[Driving style of the NPCs](scenarios.md#traffic-styles). The default is `paper`.",
    "scenario.vehicles": "[Vehicle types](scenarios.md#vehicles) of the NPCs that are not cars, such as `{NPC 1: "
    "truck}`.",
    "scenario.npcs": "[Instructions](scenarios.md) of each NPC: `{cell, speed}`, `{lane, speed}` or a single "
    "`{zone, slot, speed, act}`. Speeds are in m/s.",
    "expect.failure": "Class of the exception, or `ProcessCrash` if the process died or hung.",
    "expect.assertion": "Failed assertion, with numbers replaced by `N`, or name of the failed check. For "
    "other exceptions, the failing statement or the first line of the message.",
    "expect.check": "Values of a failed check: `value`, `at_most`, `at_least` and `unit`.",
    "expect.message": "First line of the message, unless `assertion` contains it.",
    "expect.outcome": "[How the run ended](run.md#how-a-run-ends).",
    "expect.time": "Time [s] of the failed check or, without a check, of the most important event.",
    "expect.npc, expect.cell": "NPC in the collision, and its cell. Without a collision, the NPC with the smallest "
    "time to contact. For a failed check, the NPC that the check names.",
    "expect.zone": "Zone in which the NPC crossed the ego's path, such as `crossing from the left`.",
    "expect.side, expect.closing_speed": "Side of the ego that was hit, and closing speed [m/s].",
    "expect.situation": "Positions and speeds shortly before the failure. If a replay passes, it reports whether [this "
    "situation occurred](../explanation/findings.md).",
    "expect.responsibility, expect.fault": "Who is [responsible](../explanation/verdicts.md) for the "
    "collision, and which rule the ego broke.",
    "expect.mistake": "Driving error of the ego, if `fault` is `entered-lane`.",
    "expect.npc_manoeuvre, expect.ego_manoeuvre": "Manoeuvre shortly before the collision: `lane-change` or "
    "`lane-keeping`.",
    "expect.takeover": "Latest takeover [s before the impact] by [a careful driver](../explanation/findings.md) "
    "that reliably avoids the collision. `0.0` if there is none in the last 3 s.",
    "expect.against": "Reference policy that passed, such as `module:factory`.",
    "expect.traceback": "Traceback of an exception in the policy.",
    "found.seed": "Seed of the search. It is not the value of `--pafot-seed`.",
    "found.algorithm, found.generation, found.policy": "Algorithm, generation (counted from 0) and policy of the "
    "search.",
    "found.worst_closing_speed": "Highest closing speed [m/s] of all runs with this failure in the search.",
    "found.versions": "Versions of the packages on which the run depends, and of the rules of responsibility.",
    "perception": "Arguments of [`pafot.Perception`](../guide/planners.md) that differ from their defaults.",
    "shrunk.rollouts, shrunk.before": "Number of runs used for shrinking, and size of the original scenario.",
    "shrunk.is_minimal": "True if [all simpler candidates](../explanation/findings.md) were tried.",
    "rate": "How often [a random policy](../guide/triage.md) failed: `failing` of `runs`. Each run had a different "
    "seed, unless the file is `flaky`.",
    "flaky": "Difference between two runs of the scenario. Remove this line once the failure is repeatable.",
    "test": "Node id of the test. The folder alone determines which test replays the file.",
    "world": "`kind` and arguments of the [world](worlds.md).",
    "xfail": "`reason` for [accepting the failure](../guide/triage.md), and `until`, the last day on which it is "
    "accepted.",
}
"""Meanings of the keys in a corpus file."""


def sections() -> dict[str, str]:
    """Return the text of every generated section, by name."""
    return {
        **{group: _options_table(names) for group, names in OPTION_GROUPS.items()},
        "search-record": _record_table(Search, only=SEARCH_KEYS),
        "finding-record": _record_table(finding_entry, "Keys:", only=FINDING_KEYS),
        **{group: _marker_table(names) for group, names in MARKER_GROUPS.items()},
        **{group: _properties_table(Run, only=names) for group, names in RUN_GROUPS.items()},
        "signals": _signals_table(),
        "check": _table(["Argument", "Meaning"], _arguments(check)),
        "properties": _ready_list(),
        "lane-change": _fields_table(EgoLaneChange),
        "collision": _fields_table(Collision),
        "outcomes": _outcomes_table(),
        "scenario": _fields_table(Scenario),
        "traffic": _traffic_table(),
        "vehicles": _vehicles_table(),
        "instruction": _fields_table(PositionInstruction),
        "crossing-instruction": _fields_table(CrossingInstruction),
        "lane-instruction": _fields_table(LaneInstruction),
        "highway": _fields_table(Highway),
        "world": _fields_table(World),
        "limits": _fields_table(NpcLimits),
        "simulator-world": _fields_table(SimulatorWorld),
        "simulator": _fields_table(Simulator),
        "lane-command": _fields_table(LaneCommand),
        "observation": _fields_table(Observation),
        "vehicle": _fields_table(VehicleState),
        "perception": _fields_table(Perception),
        "program": _table(["Argument", "Meaning"], _arguments(policies.process)),
        "baselines": _table(["Argument", "Meaning"], _arguments(policies.sb3)),
        "file": _file_table(),
        "example-file": f"```yaml\n{text_of(_example())}```\n",
        "search-command": _command_table(add_search_arguments, as_in_mark=OF_SEARCH),
        "results": _columns_table(
            {name: text for name, text in COMPARED.items() if run_table.COLUMNS.get(name) != text}
        ),
        "rate": _command_table(add_rate_arguments),
    }


def generated(text: str) -> str:
    """Return a document with up-to-date generated sections.

    Raises:
        KeyError: if a section has an unknown name.
    """
    made = sections()
    return _SECTION.sub(lambda found: f"{found[1]}{made[found[2]]}{found[3]}", text)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines
    )


def _columns_table(columns: Mapping[str, str]) -> str:
    return _table(["Column", "Meaning"], ([_code(name), text] for name, text in columns.items()))


def _fields_table(cls: type[Any]) -> str:
    defaults = _defaults(cls)
    has_defaults = any(defaults.values())
    header = ["Name", *(["Default"] if has_defaults else []), "Meaning"]
    rows = [
        [
            _code(names),
            *(
                [", ".join(filter(None, map(defaults.get, names.split(", "))))]
                if has_defaults
                else []
            ),
            _capital(text),
        ]
        for names, text in _attributes(cls)
    ]
    return _table(header, rows)


def _traffic_table() -> str:
    styles = [style for style in STYLES if STYLES[style].least_gap]
    rows = [
        [_code(name), *(f"{getattr(STYLES[style], name)}" for style in styles), text]
        for name, text in _attributes(DrivingStyle)
        if name not in ("described", "is_attentive")
    ]
    return _table(["Name", *map(_code, styles), "Meaning"], rows)


def _vehicles_table() -> str:
    names = ("length", "width", "acceleration", "braking", "lateral_acceleration", "top_speed")
    rows = [
        [f'`"{name}"`']
        + ["" if getattr(each, one) == math.inf else f"{getattr(each, one):g}" for one in names]
        for name, each in READY.items()
    ]
    return _table(["Name", *map(_code, names)], rows)


def _code(names: str) -> str:
    return ", ".join(f"`{name}`" for name in names.split(", "))


def _defaults(cls: type[Any]) -> dict[str, str]:
    if not is_dataclass(cls):
        return {}
    return {field.name: _default(field) for field in fields(cls)}


def _default(field: Field[Any]) -> str:
    if field.default is not MISSING:
        return f"`{field.default!r}`"
    return "" if field.default_factory is MISSING else f"`{field.default_factory.__name__}()`"  # type: ignore[union-attr]


def _attributes(thing: Any, heading: str = "Attributes:") -> Iterator[tuple[str, str]]:
    """Yield the names and descriptions in the section of a docstring with this heading."""
    _, found, block = (inspect.getdoc(thing) or "").partition(f"{heading}\n")
    entries: list[tuple[str, str]] = []
    for line in block.split("\n\n")[0].splitlines() if found else []:
        entry = _ENTRY.match(line[4:])
        if entry and not line.startswith(" " * 5):
            entries.append((entry[1], entry[2]))
        elif entries:
            entries[-1] = (entries[-1][0], f"{entries[-1][1]} {line.strip()}")
    for names, text in entries:
        yield names, _plain(text)


def _plain(text: str) -> str:
    """Return the text of a docstring as Markdown."""
    return (
        _ROLE.sub(lambda found: f"`{found[1].rpartition('.')[2]}`", text).replace("``", "`").strip()
    )


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _first_paragraph(docstring: str | None) -> str:
    return _plain(" ".join(inspect.cleandoc(docstring or "").split("\n\n")[0].split()))


def _value(function: Callable[..., Any]) -> str:
    """Return the description of a function's return value."""
    text = _first_paragraph(function.__doc__).removeprefix("Return ")
    return _capital(re.sub(r"^[Tt]he (?!\w+'s)", "", text))


def _options_table(names: Sequence[str]) -> str:
    return _table(["Option", "Default", "Meaning"], (_option_row(BY_NAME[name]) for name in names))


def _option_row(option: Option) -> list[str]:
    flag = option.flag if option.kind == "switch" else f"{option.flag}={option.metavar}"
    argument = f"{option.name}=" if option.is_argument else ""
    elsewhere = (option.key, argument) if option.everywhere else ("", "")
    is_said = all(choice in option.help for choice in option.choices)
    choices = (
        ""
        if is_said
        else f" {'Built-in:' if option.or_class else 'One of'} {_code(', '.join(option.choices))}."
    )
    place = f'<a id="{option.flag.removeprefix("--")}"></a>'
    return [
        place + "<br>".join(f"`{name}`" for name in (flag, *elsewhere) if name),
        _option_default(option),
        " ".join(filter(None, [option.help, option.details])) + choices,
    ]


def _option_default(option: Option) -> str:
    plain = "none" if option.default is None else f"`{option.default}`"
    stated = {
        "runs": f"`{RUNS}`",
        "shrink_runs": "depends on the policy",
    }
    return stated.get(option.name, plain)


def _marker_table(names: Sequence[str]) -> str:
    options = {option.name: _option_default(option) for option in OPTIONS}
    defaults = {**options, **_defaults(Request), **_defaults(SearchSpace), **MARKER_DEFAULTS}
    rows = [[_code(name), defaults[name].replace("'", '"'), MARKER_TEXTS[name]] for name in names]
    return _table(["Argument", "Default", "Meaning"], rows)


def _properties_table(cls: type[Any], only: Sequence[str] = ()) -> str:
    own = dict(_attributes(cls))
    for name, member in vars(cls).items():
        if not name.startswith("_") and name not in own:
            inner = getattr(member, "fget", None) or getattr(member, "func", None) or member
            own[name if inner is not member else f"{name}()"] = _value(inner)
    return _table(["Name", "Meaning"], [[_code(name), _capital(own[name])] for name in only or own])


def _record_table(thing: Any, heading: str = "Attributes:", only: Sequence[str] = ()) -> str:
    texts = dict(_attributes(thing, heading))
    return _table(
        ["Key", "Meaning"], [[_code(names), _capital(texts[names])] for names in only or texts]
    )


def _outcomes_table() -> str:
    body = ast.parse(inspect.getsource(Outcome)).body[0]
    assert isinstance(body, ast.ClassDef)  # noqa: S101
    after = (node.value for node in body.body[1:] if isinstance(node, ast.Expr))
    texts = [value.value for value in after if isinstance(value, ast.Constant)]
    rows = [
        [f"`{outcome}`", " ".join(str(text).split())]
        for outcome, text in zip(Outcome, texts, strict=True)
    ]
    return _table(["Outcome", "Meaning"], rows)


def _file_table() -> str:
    return _table(
        ["Field", "Meaning"], [[_code(names), text] for names, text in FILE_TEXTS.items()]
    )


def _example() -> Finding:
    cut_in = (PositionInstruction(Cell.FRONT_LEFT, 25.0), PositionInstruction(Cell.FRONT, 8.0))
    return Finding(
        id="cut-in-unanswered-1f3a9c",
        test="tests/test_safety.py::test_never_at_fault_in_a_collision",
        scenario=Scenario(npcs=(cut_in,), seed=7),
        world=Highway().to_dict(),
        expect=Expect(
            failure="AssertionError",
            assertion="not run.collision",
            outcome=Outcome.COLLISION,
            time=12.4,
            npc=0,
            cell=Cell.FRONT,
            side="front",
            closing_speed=9.8,
            responsibility="ego",
            fault="cut-in-unanswered",
        ),
        shrunk=Shrunk(rollouts=41, before="4 NPCs, 60 instructions, 60 s, hostile traffic"),
        found=Found(
            seed=1234,
            generation=17,
            algorithm="pafot",
            policy="planner:MyPlanner",
            worst_closing_speed=13.9,
            versions={"pytest-pafot": "0.1.0", "highway-env": "1.12.1", "numpy": "2.4.6"},
        ),
    )


def _signals_table() -> str:
    rows = [
        [
            f"`run.{each.name.replace('npcs', 'npcs[i]')}`",
            each.unit,
            each.worse,
            _capital(each.source) + ".",
        ]
        for each in MEASURES
    ]
    return _table(["Signal", "Unit", "Worse", "Meaning"], rows)


def _command_table(
    add: Callable[[argparse.ArgumentParser], None], as_in_mark: Sequence[str] = ()
) -> str:
    """Return the table of a command's options. The options in ``as_in_mark`` share one row, which links to the mark."""
    parser = argparse.ArgumentParser(add_help=False)
    add(parser)
    rows = []
    for action in parser._actions:
        if action.help == argparse.SUPPRESS or action.dest in as_in_mark:
            continue
        value = (
            f"={'|'.join(map(str, action.choices))}"
            if action.choices
            else f"={action.metavar or action.dest.upper()}"
        )
        value = "" if action.nargs == 0 else value
        text = _WORLD.sub(
            r"drive in this [world](../reference/worlds.md) (\1",
            (action.help or "") % vars(action),
        )
        name = f"{action.option_strings[0]}{value}" if action.option_strings else action.metavar
        if action.dest == "config":  # it belongs to --world, so they share a row
            rows[-1][0] += f", `{name}`"
        else:
            rows.append([f"`{name}`", _capital(text) + "."])
    if as_in_mark:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in as_in_mark)
        text = "Same as [the arguments of `@pafot.search`](../reference/search.md). `--help` shows the defaults."
        rows.append([_code(flags), text])
    return _table(["Option", "Meaning"], rows)


def _arguments(function: Callable[..., Any]) -> list[list[str]]:
    return [[_code(names), _capital(text)] for names, text in _attributes(function, "Args:")]


def _ready_list() -> str:
    entries = []
    for name in properties.__all__:
        function: Callable[..., Any] = getattr(properties, name)
        paragraphs = [
            _plain(" ".join(each.split()))
            for each in inspect.cleandoc(function.__doc__ or "").split("\n\n")
        ]
        paragraphs = [each for each in paragraphs if not each.startswith("Raises:")]
        text = re.sub(r"docs/([\w/]+/)([\w-]+)\.md", r"[\2](../\1\2.md)", " ".join(paragraphs))
        lines = textwrap.wrap(text, 120, break_on_hyphens=False)
        lines = [f"**`pafot.properties.{name}({_stated(function)})`**", "", *lines]
        entries.append("\n".join(lines))
    return "\n" + "\n\n".join(entries) + "\n\n"


def _stated(function: Callable[..., Any]) -> str:
    """Return a function's parameters with their defaults. A long default becomes ``...``."""
    stated = []
    for each in inspect.signature(function).parameters.values():
        default = "..." if isinstance(each.default, RssRules) else repr(each.default)
        stated.append(
            each.name if each.default is inspect.Parameter.empty else f"{each.name}={default}"
        )
    return ", ".join(stated)


if __name__ == "__main__":
    for page in REFERENCE:
        page.write_text(generated(page.read_text(encoding="utf-8")), encoding="utf-8", newline="\n")
