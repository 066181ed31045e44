"""Write the tables of guide/ and reference/ from the docstrings and options in the code.

Run it after a change of the code or of the tables: ``python docs/tools/generate.py``.
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

from pytest_pafot import criticality, plugin, policies, properties, strategies
from pytest_pafot.campaign import run_table
from pytest_pafot.campaign.events import Search
from pytest_pafot.campaign.options import BY_NAME, OPTIONS, RUNS, Option
from pytest_pafot.campaign.request import Request, SearchArguments
from pytest_pafot.commands.rate_command import add_arguments as add_rate_arguments
from pytest_pafot.commands.search_command import add_arguments as add_search_arguments
from pytest_pafot.comparison.command import add_arguments
from pytest_pafot.comparison.plan import COLUMNS as COMPARED
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.criticality import Passage, RssRules
from pytest_pafot.criticality.signals import MEASURES, EgoLaneChange
from pytest_pafot.export.exporter import add_arguments as add_export_arguments
from pytest_pafot.findings.finding import Expect, Finding, Found
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.instructions import (
    Cell,
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Collision, Outcome
from pytest_pafot.model.vehicle_type import READY, STYLES, DrivingStyle, VehicleType
from pytest_pafot.oracle.run import Run, check
from pytest_pafot.report.session_record import finding_entry, to_text
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.world import (
    Control,
    CrossingVehicle,
    Drive,
    Highway,
    NpcLimits,
    Observation,
    Perception,
    Simulator,
    SimulatorWorld,
    Vehicle,
    VehicleState,
    World,
)

DOCS = Path(__file__).parents[1]
REFERENCE = [*sorted(DOCS.glob("reference/*.md")), *sorted(DOCS.glob("guide/*.md"))]

_SECTION = re.compile(r"(<!-- generated: ([a-z-]+) -->\n).*?(<!-- end of generated -->)", re.DOTALL)
_ROLE = re.compile(r":(?:class|func|attr|meth|data|mod):`~?\.?([^`]+)`")
OF_SEARCH = ("traffic", "blame", "runs", "seed", "against")
"""The options of ``search`` that are arguments of the mark."""
_WORLD = re.compile(
    r"drive in this world: the id of a highway-env environment .* a pafot.SimulatorWorld \((.*)", re.DOTALL
)
_ENTRY = re.compile(r"^(\w+(?:, \w+)*): (.*)$")

MARKER_TEXTS: Mapping[str, str] = {
    "world": "`pafot.Highway(...)`, `pafot.World(...)`, `pafot.SimulatorWorld(...)`, or [a text that names "
    "one](../guide/own-world.md#in-every-command), such as `module:factory`.",
    "ads": "Fixture that gives the ADS factory; or the factory, or its `module:factory[:argument]`.",
    "fitness": "[The fitness](fitness.md): a name, a measure, or a function of the trace.",
    "blame": '[Which failures count](../explanation/findings.md#what-counts-as-a-failure): `"any"` or `"ego"`.',
    "traffic": '[How the others drive](../explanation/traffic.md): `"hostile"`, `"assertive"`, `"everyday"`, '
    'or `"paper"`.',
    "instructions": '[What NPCs that do not cross do](../explanation/default-search.md#why-both-kinds): `"cells"`, '
    '`"lanes"` or `"both"`.',
    "vehicles": "[What NPCs can be](scenarios.md#vehicles): names, or `pafot.VehicleType(...)`. With cars among them, "
    "one NPC in six is another one.",
    "gene_seconds": "Duration of one gene [s].",
    "ego_lane": "The ego's first lane, from 0 at the left.",
    "npcs": "Number of NPCs, 1 to 8.",
}
"""Meanings of arguments that no docstring explains."""

MARKER_DEFAULTS: Mapping[str, str] = {
    "ads": '`"ads"`',
    "world": "the fixture `pafot_world`",
    "genes": "as many as fill the run",
    "npcs": "[sampled](#what-is-sampled)",
    "gene_seconds": "sampled",
    "traffic": '`"hostile"`, or `"paper"`',
    "instructions": '`"both"`, or `"cells"`',
    "vehicles": "all that fit the road; cars for the other algorithms",
    "ego_lane": "sampled",
    "ego_speed": "sampled",
}
"""Defaults that no dataclass contains."""

FILE_TEXTS: Mapping[str, str] = {
    "pafot": "Version of the format, `3`.",
    "test": "Node id of the test; the folder decides which test replays the file.",
    "world": "`kind` is `highway` or `gym`, with the fields of `Highway` or `World`; `ego` only if it is no car. The "
    "kinds `metadrive` and `sumo` have `data`. Of a world that is code (`own`, or with `wrappers`) the replay uses the "
    "test's.",
    "scenario.seed": "Of all random choices in the run.",
    "scenario.ego": "`lane`, from 0 at the left, and `speed` [m/s], also of NPCs that do not cross, at the start.",
    "scenario.gene_seconds": "Duration of a gene [s]; by default `10.0`.",
    "scenario.traffic": "[The style](../explanation/traffic.md); by default the paper's.",
    "scenario.vehicles": "[Vehicles](scenarios.md#vehicles) of NPCs that are no cars, by their names: a name, or "
    "`{name, length, width, ...}`.",
    "scenario.npcs": "By the names `NPC 0`, `NPC 1` ... the list of [instructions](scenarios.md) of each NPC: `{cell, "
    "speed}`, with the name of a cell, `{lane, speed}`, or one `{zone, slot, speed, act}`. Speeds are in m/s.",
    "expect.failure": "Class of the exception; `ProcessCrash` if the process died or hung.",
    "expect.assertion": "The failing assertion, with `N` for each number; the name of a failed check; of another "
    "exception, its statement or first line.",
    "expect.message": "First line of the message, if `assertion` does not say it.",
    "expect.time": "Of the event [s]: of the failed check, otherwise `event_time`.",
    "expect.check": "Of a failed check: `value`, `at_most`, `at_least`, `unit`.",
    "expect.situation": "The [situation](../explanation/findings.md#what-a-replay-means) shortly before the failure: "
    "`npc`, `time` [s], the `gap` between the bumpers [m] (negative side by side), the `place` of the NPC (`ahead` or "
    "`behind`), `lanes_to_right` of the ego (negative: to the left), `ego_speed` and `npc_speed` [m/s] (of a leader, "
    "its lowest from then on). Where ways meet, the times to the zone `npc_enters` and `ego_enters` [s] replace it.",
    "expect.takeover": "[The latest takeover](../explanation/findings.md#what-a-careful-driver-would-have-done) by a "
    "careful driver that avoids the collision [s before the impact]; `0.0` if none of the last 3 s does.",
    "expect.mistake": "[What the ego did wrong](../explanation/findings.md#what-makes-two-failures-the-same), for "
    "`entered-lane`.",
    "perception": "The arguments of [`pafot.Perception`](ads.md#imperfect-sight) that are no defaults.",
    "shrunk.rollouts": "Runs that shrinking took.",
    "shrunk.before": "The size of the scenario as first found, which shrinking has replaced.",
    "shrunk.is_minimal": "True if [all simpler candidates](../explanation/findings.md#how-a-finding-is-shrunk) were "
    "tried.",
    "rate": "How often [a policy that draws random numbers](../guide/random-policies.md) fails: `failing` of `runs`, "
    "each with another seed, or of a flaky one with the same.",
    "flaky": "What differed when the scenario was run again. Remove the line when it repeats.",
    "xfail": "[Why you accept the failure](../guide/triage.md#accept-a-failure-for-a-while), and up to which day: "
    "`{reason: ..., until: 2027-01-31}`.",
    "expect.closing_speed": "Of the collision [m/s].",
    "expect.against": "The reference that passed, such as `module:factory`.",
    "expect.npc, expect.cell": "At the collision, otherwise at the smallest time to contact; of a check, the NPC that "
    "it names.",
    "expect.npc_manoeuvre, expect.ego_manoeuvre": "Shortly before the collision.",
    "expect.traceback": "Of an ADS that raised, without addresses, process ids and temporary folders.",
    "found.seed": "Of the search; no value for `--pafot-seed`.",
    "found.generation": "Counted from 0.",
    "found.policy": "Name of the policy, such as `planner:MyPlanner`; of a lambda, the class that it makes.",
    "found.worst_closing_speed": "Of the worst run of that search that failed alike [m/s]. A run that is 1 m/s faster "
    "[is not accepted](../guide/triage.md#accept-a-failure-for-a-while).",
    "found.versions": "Of the packages that the run depends on, and of the rules of verdicts.",
}
"""Meanings of keys that no docstring explains for a reader of files, or only at length."""

RUN_INTERNALS = (
    *("take_over", "facts"),
    *("event_npc", "event_cell", "closest_time", "zone_of", "place_of"),
)
"""Arguments of a run that only who makes a run gives, and what pages and summaries need; the Python API has them."""

AT_THE_END = ("perception", "shrunk", "rate", "flaky", "test", "world", "xfail")
"""Keys of a file that follow the keys of dataclasses. All are optional."""


def sections() -> dict[str, str]:
    """Return the text of every generated section, by name."""
    return {
        "options": _options_table(),
        "session-record": _record_table(to_text, "Keys:"),
        "search-record": _record_table(Search),
        "finding-record": _record_table(finding_entry, "Keys:"),
        "marker": _marker_table(),
        "fixtures": _fixtures_table(),
        "run": _properties_table(Run, without=RUN_INTERNALS),
        "signals": _signals_table(),
        "check": _table(["Argument", "Meaning"], _arguments(check)),
        "properties": _ready_list(),
        "lane-change": _fields_table(EgoLaneChange),
        "passage": _fields_table(Passage),
        "collision": _fields_table(Collision),
        "outcomes": _outcomes_table(),
        "scenario": _fields_table(Scenario),
        "traffic": _traffic_table(),
        "vehicle-type": _fields_table(VehicleType),
        "vehicles": _vehicles_table(),
        "instruction": _fields_table(PositionInstruction),
        "crossing-instruction": _fields_table(CrossingInstruction),
        "lane-instruction": _fields_table(LaneInstruction),
        "highway": _fields_table(Highway),
        "world": _fields_table(World),
        "limits": _fields_table(NpcLimits),
        "simulator-world": _fields_table(SimulatorWorld),
        "simulator": _fields_table(Simulator),
        "simulator-vehicle": _fields_table(Vehicle),
        "simulator-control": _fields_table(Control),
        "drive": _fields_table(Drive),
        "observation": _fields_table(Observation),
        "vehicle": _fields_table(VehicleState),
        "crossing-vehicle": _fields_table(CrossingVehicle),
        "zone": _fields_table(Zone),
        "perception": _fields_table(Perception),
        "program": _table(["Argument", "Meaning"], _arguments(policies.process)),
        "baselines": _table(["Argument", "Meaning"], _arguments(policies.sb3)),
        "measures": _measures_table(),
        "file": _file_table(),
        "example-file": f"```yaml\n{text_of(_example())}```\n",
        "strategies": _strategies_table(),
        "compare": _command_table(add_arguments),
        "search-command": _command_table(add_search_arguments, as_in_mark=OF_SEARCH),
        "run-table": _columns_table(run_table.COLUMNS),
        "results": _columns_table(
            {name: text for name, text in COMPARED.items() if run_table.COLUMNS.get(name) != text}
        ),
        "export": _command_table(add_export_arguments),
        "rate": _command_table(add_rate_arguments),
    }


def generated(text: str) -> str:
    """Return a document with its generated sections as the code has them now.

    Raises:
        KeyError: if a section has a name that is not generated.
    """
    made = sections()
    return _SECTION.sub(lambda found: f"{found[1]}{made[found[2]]}{found[3]}", text)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def _columns_table(columns: Mapping[str, str]) -> str:
    return _table(["Column", "Meaning"], ([_code(name), text] for name, text in columns.items()))


def _fields_table(cls: type[Any]) -> str:
    defaults = _defaults(cls)
    has_defaults = any(defaults.values())
    header = ["Name", *(["Default"] if has_defaults else []), "Meaning"]
    rows = [
        [
            _code(names),
            *([", ".join(filter(None, map(defaults.get, names.split(", "))))] if has_defaults else []),
            text,
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
        [f'`"{name}"`'] + ["" if getattr(each, one) == math.inf else f"{getattr(each, one):g}" for one in names]
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
    """Yield the names and texts of a docstring's block with this heading."""
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
    return _ROLE.sub(lambda found: f"`{found[1].rpartition('.')[2]}`", text).replace("``", "`").strip()


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _first_paragraph(docstring: str | None) -> str:
    return _plain(" ".join(inspect.cleandoc(docstring or "").split("\n\n")[0].split()))


def _value(function: Callable[..., Any]) -> str:
    """Return the description of what a function returns."""
    text = _first_paragraph(function.__doc__).removeprefix("Return ")
    return _capital(re.sub(r"^[Tt]he (?!\w+'s)", "", text))


def _options_table() -> str:
    header = ["Command line, ini or toml key, argument of the mark", "Default", "Meaning"]
    return _table(header, map(_option_row, OPTIONS))


def _option_row(option: Option) -> list[str]:
    flag = option.flag if option.kind == "switch" else f"{option.flag}={option.metavar}"
    argument = f"{option.name}=" if option.is_argument else ""
    elsewhere = (option.key, argument) if option.everywhere else ("", "")
    is_said = all(choice in option.help for choice in option.choices)
    choices = "" if is_said else f" One of {_code(', '.join(option.choices))}."
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
        "shrink_rollouts": "by the ADS",
    }
    return stated.get(option.name, plain)


def _marker_table() -> str:
    texts = {**dict(_attributes(SearchSpace)), **MARKER_TEXTS}
    defaults = {**_defaults(Request), **_defaults(SearchSpace), **MARKER_DEFAULTS}
    given = sorted(SearchArguments.__annotations__, key=lambda name: name not in ("world", "ads"))
    names = [name for name in given if name not in BY_NAME]
    rows = [[_code(name), defaults[name].replace("'", '"'), _capital(texts[name])] for name in names]
    return _table(["Argument", "Default", "Meaning"], rows)


def _fixtures_table() -> str:
    tree = ast.parse(inspect.getsource(plugin))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("pafot_")]
    rows = [[f"`{node.name}`", _scope(node), _first_paragraph(ast.get_docstring(node))] for node in functions]
    return _table(["Fixture", "Scope", "Value"], rows)


def _scope(node: ast.FunctionDef) -> str:
    keywords = [word for each in node.decorator_list if isinstance(each, ast.Call) for word in each.keywords]
    return next((str(word.value.value) for word in keywords if isinstance(word.value, ast.Constant)), "function")


def _properties_table(cls: type[Any], without: Sequence[str] = ()) -> str:
    own = {name: text for name, text in _attributes(cls) if name not in without}
    for name, member in vars(cls).items():
        if not name.startswith("_") and name not in (*own, *without):
            inner = getattr(member, "fget", None) or getattr(member, "func", None) or member
            own[name if inner is not member else f"{name}()"] = _value(inner)
    return _table(["Name", "Meaning"], [[_code(name), _capital(text)] for name, text in own.items()])


def _record_table(thing: Any, heading: str = "Attributes:") -> str:
    return _table(["Key", "Meaning"], [[_code(name), _capital(text)] for name, text in _attributes(thing, heading)])


def _outcomes_table() -> str:
    body = ast.parse(inspect.getsource(Outcome)).body[0]
    assert isinstance(body, ast.ClassDef)  # noqa: S101
    after = (node.value for node in body.body[1:] if isinstance(node, ast.Expr))
    texts = [value.value for value in after if isinstance(value, ast.Constant)]
    rows = [[f"`{outcome}`", " ".join(str(text).split())] for outcome, text in zip(Outcome, texts, strict=True)]
    return _table(["Outcome", "Meaning"], rows)


def _file_table() -> str:
    described = {
        ", ".join(f"{part}.{name}" for name in names.split(", ")): _capital(text)
        for part, cls in (("expect", Expect), ("found", Found))
        for names, text in _attributes(cls)
    }
    described |= {names: text for names, text in FILE_TEXTS.items() if names in described}
    own = {names: text for names, text in FILE_TEXTS.items() if names not in described}
    last = {name: own.pop(name) for name in list(own) if name.partition(".")[0] in AT_THE_END}
    return _table(["Field", "Meaning"], [[_code(names), text] for names, text in (own | described | last).items()])


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


def _measures_table() -> str:
    functions = [getattr(criticality, name) for name in criticality.__all__]
    measures = [each for each in functions if inspect.isfunction(each) and next(iter(_parameters(each))) == "trace"]
    rows = [[f"`{each.__name__}`", _value(each)] for each in measures if not each.__name__.startswith("min_")]
    return _table(["Measure", "Meaning"], rows)


def _signals_table() -> str:
    rows = [
        [f"`run.{each.name.replace('npcs', 'npcs[i]')}`", each.unit, each.worse, _capital(each.source) + "."]
        for each in MEASURES
    ]
    return _table(["Signal", "Unit", "Worse", "Meaning"], rows)


def _parameters(function: Callable[..., Any]) -> Iterable[str]:
    return inspect.signature(function).parameters


def _command_table(add: Callable[[argparse.ArgumentParser], None], as_in_mark: Sequence[str] = ()) -> str:
    """Return the table of a command's options; those of ``as_in_mark`` are one row, which leads to the mark's."""
    parser = argparse.ArgumentParser(add_help=False)
    add(parser)
    rows = []
    for action in parser._actions:
        if action.help == argparse.SUPPRESS or action.dest in as_in_mark:
            continue
        value = (
            f"={'|'.join(map(str, action.choices))}" if action.choices else f"={action.metavar or action.dest.upper()}"
        )
        value = "" if action.nargs == 0 else value
        text = _WORLD.sub(
            r"drive in this world ([all forms](../guide/own-world.md#in-every-command); \1",
            (action.help or "") % vars(action),
        )
        name = f"{action.option_strings[0]}{value}" if action.option_strings else action.metavar
        if action.dest == "config":  # the page on all forms of a world explains it
            rows[-1][0] += f", `{name}`"
        else:
            rows.append([f"`{name}`", _capital(text) + "."])
    if as_in_mark:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in as_in_mark)
        rows.append([_code(flags), "As [the mark's arguments](../reference/search.md); `--help` has the defaults."])
    return _table(["Option", "Meaning"], rows)


def _arguments(function: Callable[..., Any]) -> list[list[str]]:
    return [[_code(names), _capital(text)] for names, text in _attributes(function, "Args:")]


def _ready_list() -> str:
    entries = []
    for name in properties.__all__:
        function: Callable[..., Any] = getattr(properties, name)
        paragraphs = [_plain(" ".join(each.split())) for each in inspect.cleandoc(function.__doc__ or "").split("\n\n")]
        paragraphs = [each for each in paragraphs if not each.startswith("Raises:")]
        text = re.sub(r"docs/([\w/]+/)([\w-]+)\.md", r"[\2](../\1\2.md)", " ".join(paragraphs))
        lines = textwrap.wrap(text, 120, break_on_hyphens=False)
        lines = [f"**`pafot.properties.{name}({_stated(function)})`**", "", *lines]
        entries.append("\n".join(lines))
    return "\n" + "\n\n".join(entries) + "\n\n"


def _stated(function: Callable[..., Any]) -> str:
    """Return the parameters of a function with their defaults, long ones as ``...``."""
    stated = []
    for each in inspect.signature(function).parameters.values():
        default = "..." if isinstance(each.default, RssRules) else repr(each.default)
        stated.append(each.name if each.default is inspect.Parameter.empty else f"{each.name}={default}")
    return ", ".join(stated)


def _strategies_table() -> str:
    rows = []
    for name in strategies.__all__:
        function: Callable[..., Any] = getattr(strategies, name)
        rows.append([f"`pafot.strategies.{name}()`", _capital(_value(function).removeprefix("A strategy for "))])
    return _table(["Strategy", "Generates"], rows)


if __name__ == "__main__":
    for page in REFERENCE:
        page.write_text(generated(page.read_text(encoding="utf-8")), encoding="utf-8", newline="\n")
