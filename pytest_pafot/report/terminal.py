"""The plugin's text in the terminal: progress, each finding, why a search fails, and the summary of the session.

All functions are pure: they turn values into lines of plain ASCII that fit the terminal's width, except for node ids,
paths and the user's own words.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pytest_pafot.campaign.events import UNTESTED, Ending, Progress, Search
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Expect, Finding
from pytest_pafot.findings.severity import Severity, worsening
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import ReferenceOutcome
from pytest_pafot.report.session import WHY_UNNAMED, Session
from pytest_pafot.support.errors import command, flag
from pytest_pafot.support.proportions import interval_text, none_text
from pytest_pafot.support.text import ascii_text, fitted_lines, listed, plural, wrapped_to

WIDTH = 80
MINUTE, HOUR = 60, 3600
LONG = 600
"""The time that is left from which on a line of progress names the option that ends a search [s]."""
EXPENSIVE = 0.001
"""The mean time of a decision from which on the summary counts decisions [s]: below that, other things take longer."""
MAX_FINDS = 20
"""The largest number of new findings that a search lists one by one."""

PARAMETERS = re.compile(r"^([^\[]*::[^\[]*)\[(.*)\]$")
"""A node id with parameters: the test without them, and the parameters."""
SEARCH = "-search"
"""The end of the name of a search, behind the parameters of its test."""

MAX_ANNOTATED = 5
"""The largest number of findings that a CI job tells whole."""

MAX_LEFT = 5
"""The largest number of saved scenarios that were left out and are named."""
MAX_REPLAYS = 10
"""The largest number of listed replays. Only replays that do not simply fail as before are listed."""

MAX_WHOLE = 5
"""The largest number of searches without a failing run whose whole text is printed; of more, each is a line."""

PURPOSES = {"search": "decisions", "confirm": "to confirm", "shrink": "to shrink", "moment": "to find the moment"}
"""What runs and decisions of a policy are for, in words."""

_BESIDE: Mapping[ReferenceOutcome, str] = {
    "avoids": "",
    "hit": " (hit, not at fault)",
    "at-fault": " (at fault)",
    "fails": " (fails too)",
}
"""The remark behind the name of a reference driver, by how its run ended."""


def progress_line(progress: Progress, width: int = WIDTH) -> str:
    """Return one line of progress. To fit the width, the start of the node id is left out, then the end of the line."""
    speed = progress.runs / progress.seconds if progress.seconds > 0 else 0.0
    pace = f"{1 / speed:.0f} s a run" if 0 < speed < 1 else f"{speed:.0f}/s"
    counts = [f"{progress.generation}/{progress.generations} generations"] if progress.generations is not None else []
    counts += [plural(progress.runs, "run") if progress.budget is None else f"{progress.runs}/{progress.budget} runs"]
    done = f"{', '.join(counts)}, {progress.failing} failing, {progress.finds} new, {pace}{_time_left(progress)}"
    tail = f" {progress.phase or done}"
    room = max(12, width - len(tail) - 8)
    name = ascii_text(progress.node_id)
    name = name if len(name) <= room else f"...{name[3 - room :]}"
    return f"pafot: {name}{tail}"[:width]


def _time_left(progress: Progress) -> str:
    """Return in words how long the runs take that are left, and what ends them; empty for less than a minute."""
    seconds = progress.left
    if seconds < MINUTE:
        return ""
    duration = f"{seconds / HOUR:.1f} h" if seconds >= 2 * HOUR else f"{seconds / MINUTE:.0f} min"
    each = f" at {1000 * progress.decision_seconds:.3g} ms a decision" if progress.decision_seconds else ""
    way_out = "" if progress.is_limited or seconds < LONG else f"; {flag('max_time', LONG)} ends it"
    return f", about {duration} left{each}{way_out}"


def found_lines(sighting: Seen, width: int = WIDTH, *, story: Sequence[str] = (), again: str = "") -> list[str]:
    """Return the lines that report a new finding while the search continues. Its file already exists.

    Args:
        sighting: the finding.
        width: the width of the terminal in columns.
        story: what its run shows, for the finding that is shown whole.
        again: the command that runs its file, likewise.
    """
    lines = [ascii_text(f"pafot: found {sighting.node_id}"), *_wrapped(sighting.summary, width)]
    lines += [line for each in story for line in _wrapped(each, width)]
    if not sighting.path:
        return [*lines, *_wrapped(f"not saved: {sighting.detail}", width)]
    if again:
        saved = "saved" if sighting.path in again else f"saved as {sighting.path}"
        lines.append(ascii_text(f"  {saved}; run it with: {again}"))
    return lines


def find_section(
    sighting: Seen,
    *,
    explanation: str,
    first: Sequence[str] = (),
    details: Sequence[str] = (),
    advice: str = "",
    width: int = WIDTH,
) -> str:
    """Return the section on a new finding in its failure report, without what the failure message says already.

    Args:
        sighting: the finding.
        explanation: the explanation of the run; empty if the failure message contains it.
        first: lines that come before those on the policy's decisions.
        details: further lines, each of which begins with a title of at most ten letters.
        advice: a text that follows the finding's remark.
        width: the width of the terminal in columns.
    """
    fitted = fitted_lines(map(ascii_text, [*explanation.splitlines(), *first, *sighting.on_decisions()]), width)
    # A path is not wrapped, so that it can be copied.
    fitted += [ascii_text(f"saved as   {sighting.path}")] if sighting.path else []
    stop = (
        f"; {flag('debug')} stops in the decision at {sighting.moment.time:.1f} s"
        if sighting.moment is not None
        else ""
    )
    rest = [f"run it     pytest FILE{stop}"] if sighting.path else [f"not saved  {sighting.detail}"]
    rest += (
        [*details, f"note       {'; '.join(filter(None, (sighting.remark, advice)))}"] if sighting.remark else details
    )
    fitted += fitted_lines(map(ascii_text, rest), width)
    if not sighting.path and sighting.detail != flag("save", "none"):
        content = text_of(sighting.finding).rstrip().splitlines()
        fitted += ["the file would be:", *(ascii_text(f"  {line}") for line in content)]
    return "\n".join(fitted)


def simplified_lines(finding: Finding) -> list[str]:
    """Describe how a new finding shrank and who does not prevent it."""
    lines = [f"shrunk     {how}" for how in shrunk_lines(finding)]
    prevention = prevention_text(finding.expect)
    return [*lines, prevention] if prevention else lines


def shrunk_lines(finding: Finding) -> list[str]:
    """Say in at most one line from what size to what size a finding shrank."""
    if finding.shrunk is None:
        return []
    found, is_minimal = finding.original, finding.shrunk.is_minimal
    sizes = [size_of(each or finding.scenario, finding.longest_run).split(", ") for each in (found, None)]
    changed = [pair for pair in zip(*sizes, strict=True) if pair[0] != pair[1]]
    how = f"from {', '.join(old for old, _ in changed)} to {', '.join(new for _, new in changed)}"
    if not changed:
        how = "to nothing simpler so far" if found is None else "to a simpler scenario of the same size"
    if found is None and is_minimal:
        return []
    return [how if is_minimal else f"{how}, and could be simpler"]


def prevention_text(expect: Expect) -> str:
    """Say which reference drivers would have prevented a finding and which not; empty if none would have failed."""
    drivers, preventing = expect.reference_drivers, expect.preventable_by
    if len(preventing) == len(drivers):
        return ""  # true of nearly all findings, so it would distinguish none
    clauses: list[str] = []
    for outcome, beside in _BESIDE.items():
        names = [name for name, became in drivers.items() if became == outcome]
        if names:
            negation = "" if names[0] in preventing else "not "
            clauses.append(f"{negation}{'' if clauses else 'preventable '}by {', '.join(names)}{beside}")
    return "; ".join(clauses)


def _worst_first(finds: Iterable[Seen]) -> list[Seen]:
    """Sort new findings, the worst first, as in all lists."""
    return sorted(
        finds,
        key=lambda each: (
            *Severity.worst_first(each.responsible, each.severity),
            -each.alike.runs,
            each.node_id,
        ),
    )


def failure_message(search: Search) -> str:
    """Return why the item of a search fails: its new findings. Each one is also reported as a separate item."""
    firm, flaky = [], []
    for sighting in _worst_first(search.finds):
        measured = "" if sighting.severity is None else f", {sighting.severity}"
        name = f"{sighting.id} ({plural(1 + sighting.alike.runs, 'run')}{measured})"
        if sighting.is_flaky:
            never = "" if sighting.finding.rate else ", so it is never reported as fixed"
            why = "; ".join(filter(None, [sighting.finding.flaky, sighting.finding.on_rate]))
            flaky.append(f"  {name} is flaky{never}: {why}")
        else:
            firm.append(name)
    count = plural(len(search.finds), "new finding")
    first = f"{count} in {plural(search.runs, 'run')}, reported below"
    return "\n".join([first, *([f"  {_listed(firm)}"] if firm else []), *flaky])


def search_lines(search: Search, *, width: int = WIDTH) -> list[str]:
    """Summarise a search in a few lines; more if there is something to report."""
    # A search that made all that was asked for needs no counts here: the line of its runs and its end say them.
    made = {"generations": search.generations, "runs": search.runs}
    left = [(made[what], most, what[:-1]) for what, most in search.asked.items() if made[what] < most]
    short = [f"{done} of {plural(most, what)}, " for done, most, what in left]
    origin = (
        f"{search.algorithm}, seed {search.seed} from {flag('seed', search.base_seed)}, "
        f"{''.join(short)}ended: {search.reason}"
    )
    # Of a search that found nothing, the start of the ego and the kinds of vehicles are details.
    told = search.drawn.partition("; ")[0] if _is_quiet(search) else search.drawn
    drawn = [told] if told else []
    texts = [*_decisions(search), *_find_lines(search), *_comparison(search)]
    lists = [origin, *drawn]
    failing, counted, checks = (search.random[each] for each in ("at_fault", "runs", "checks"))
    if counted:
        rest = search.random["otherwise"] - checks
        broke = f"{checks} {'more ' if failing else ''}failed a check" if checks else ""
        failed = ", ".join(filter(None, [broke, f"{rest} failed in other ways" if rest else ""]))
        others = f"; {failed}" if failed else ""
        share = interval_text(failing, counted)
        share = f", {share}" if failing else share.removeprefix("0 %")
        lists.append(f"random scenarios: {failing} of {counted} failed by the ego's fault{share}{others}")
    lines = [
        *_wrapped(_figures(search), width, phrases=True),
        *(line for text in texts for line in _wrapped(text, width)),
        *(line for text in lists for line in _wrapped(text, width, phrases=True)),
    ]
    texts = []
    for id_, count in sorted(search.known.items()):
        texts.append(f"{plural(count, 'run')} {'fails' if count == 1 else 'fail'} like saved-{id_}, not looked at")
        unlike = search.unlike.get(id_, ())
        texts += [f"of them, unlike saved-{id_}: {', '.join(unlike)}"] if unlike else []
    texts += [f"warning: {warning}" for warning in search.warnings]
    texts += [f"note: {note}" for note in (*search.process_notes, *search.notes)]
    return [search.node_id, *lines, *(line for text in texts for line in _wrapped(text, width))]


def _figures(search: Search) -> str:
    kinds, more = search.kinds, search.more_runs
    counts = (
        (more["known"], "not run again"),
        (kinds["failed"], "failing"),
        (kinds["npc"] + kinds["avoidable"], "npc at fault"),
        (kinds["unpreventable"], "not preventable"),
        (kinds["common"], "failing with both"),
        *((kinds[kind], kind) for kind in UNTESTED),
        (search.no_interaction, "without interaction"),
    )
    parts = [f"{count} {what}" for count, what in counts if count or what == "failing"]
    parts += [] if search.reached is None else [f"NPCs reached {search.reached:.0%} of their goals"]
    several = [plural(search.runs, "run")]
    several += [f"{more[name]} {PURPOSES[name]}" for name in ("shrink", "moment") if more[name]]
    return ", ".join([f"{listed(several)} in {search.seconds:.1f} s", *parts])


def _decisions(search: Search) -> list[str]:
    """Count the decisions of a policy by what they were for, if a search takes long and they take most of the time."""
    made = search.decisions
    if not made.total() or search.seconds < max(MINUTE, EXPENSIVE * made.total()):
        return []
    return [listed([f"{made[name]:,} {purpose}" for name, purpose in PURPOSES.items() if made[name]])]


def _find_lines(search: Search) -> list[str]:
    """Say how many new findings a search has and in which folder they are saved. Their own reports name them."""
    if not search.finds:
        return []
    folders = dict.fromkeys(os.path.dirname(sighting.path) for sighting in search.finds if sighting.path)  # noqa: PTH120
    problems = dict.fromkeys(sighting.detail for sighting in search.finds if not sighting.path)
    worst = [f"{each.id}: {each.on_alike}" for each in _worst_first(search.finds) if each.on_alike]
    flaky = sum(sighting.is_flaky for sighting in search.finds)
    first = plural(len(search.finds), "new finding")
    first += f" ({flaky} flaky)" if flaky else ""
    first += f", saved in {' and '.join(folders)}" if folders else ""
    return [first, *(f"not saved: {problem}" for problem in problems), *worst[:MAX_FINDS]]


def _comparison(search: Search) -> list[str]:
    """Say whether the policy became worse, and which findings do not count because it did not."""
    lines = [search.compared] if search.compared else []
    if search.no_worse:
        names = [f"{id_} ({headline})" if headline else id_ for id_, headline in search.no_worse.items()]
        lines.append(f"fails elsewhere: {_listed(names)}; {flag('pairs', 0)} counts and saves it")
    return lines


def replay_lines(replays: Sequence[Seen], width: int = WIDTH) -> list[str]:
    """Return the lines on all replays: a count by label, then the replays that a reader should look at."""
    if not replays:
        return []
    counts = sorted(Counter(replay.label for replay in replays).items())
    figures = ", ".join(f"{count} {result}" for result, count in counts)
    lines = wrapped_to(f"replayed {plural(len(replays), 'saved scenario')}: {figures}", width)
    shown = [
        each for each in replays if each.label != "still failing" or each.on_search or each.compared == "introduced"
    ]
    for replay in shown[:MAX_REPLAYS]:
        lines.append(f"  {replay.label}: {replay.node_id}")
        remarks = "; ".join(filter(None, [replay.on_search, replay.detail]))
        lines += [f"  {line}" for line in _wrapped(remarks, width - 2)] if remarks else []
    return [*lines, f"  ... and {len(shown) - MAX_REPLAYS} more"] if len(shown) > MAX_REPLAYS else lines


def against_lines(session: Session, width: int = WIDTH) -> list[str]:
    """Say for each reference what changes with the policy: failures that it introduces, fixes or shares.

    A session with a test that could not be compared says nothing of that: its figures would be those of a part.
    """
    lines: list[str] = []
    if session.incomparable:
        return lines
    replays = session.replays
    names = [*(each.against for each in session.ended), *(each.observed.against for each in replays)]
    for name in filter(None, dict.fromkeys(names)):
        own = [each for each in replays if each.observed.against == name]
        counts = Counter(replay.compared for replay in own)
        found = sum(len(each.finds) for each in session.ended if each.against == name)
        introduced = plural(found + counts["introduced"], "failure")
        text = f"against {name}: introduces {introduced}, fixes {counts['fixed']}, {counts['common']} as before"
        elsewhere = sum(len(each.no_worse) for each in session.ended if each.against == name)
        text += f", {elsewhere} elsewhere" if elsewhere else ""
        lines += wrapped_to(text, width)
        common = [each for each in own if each.compared == "common"]
        changes = [(each.id, worsening(each.severity, each.observed.before)) for each in common]
        worse = [f"{id_} {change}" for id_, change in changes if change]
        if worse:
            count = f"{len(worse)} of {plural(len(common), 'failure')} in common became worse"
            lines += wrapped_to(f"{count}: {'; '.join(worse[:MAX_REPLAYS])}", width)
    return lines


def worst_lines(session: Session, width: int = WIDTH) -> list[str]:
    """Return a list of all failures of a session, the worst first; empty if there are fewer than two.

    New failures are before known failures. Within both groups, failures for which the ego is responsible are first.
    """
    failing = [each for each in session.replays if each.headline and each.label != "accepted"]
    listed = sorted(
        (
            each.label != "new" and each.compared != "introduced",
            *Severity.worst_first(each.responsible, each.severity),
            -each.alike.runs,
            each.node_id,
            _measured(each),
        )
        for each in (*session.finds, *failing)
    )
    if len(listed) < 2:
        return []
    lines = [line for *_, text in listed[:MAX_FINDS] for line in wrapped_to(f"  {text}", width)]
    more = [f"  ... and {len(listed) - MAX_FINDS} more"] if len(listed) > MAX_FINDS else []
    return ["failures, the worst first:", *lines, *more]


def _measured(sighting: Seen) -> str:
    """Return a line with a failure's label and id, how bad it is, and who is responsible."""
    name = f"{sighting.label}: {sighting.id}{_parameters(sighting.finding.test)}"
    if sighting.severity is None:
        return f"{name} has no measure"
    who = f", {sighting.responsible} at fault" if sighting.severity.is_fault(sighting.responsible) else ""
    return f"{name} {sighting.severity}{who}"


def _parameters(test: str) -> str:
    """Return the parameters of a test behind a space, such as `` [planner-a]``; empty if it has none."""
    found = PARAMETERS.search(test)
    return f" [{found[2]}]" if found else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterShare:
    """The share of random scenarios in which a test failed with one set of its parameters.

    Attributes:
        parameters: the parameters, as in the node id.
        failing, runs: the number of random scenarios in which it failed, and of all of them.
        impact: the highest closing speed at an impact of its new findings [m/s]; None without an impact.
    """

    parameters: str
    failing: int
    runs: int
    impact: float | None

    @property
    def result(self) -> str:
        """The result in words."""
        hits = "" if self.impact is None else f", hits at {self.impact:.1f} m/s"
        return f"fails in {self.failing} of {self.runs} random scenarios{hits}"


def parameter_shares(searches: Iterable[Search]) -> dict[str, list[ParameterShare]]:
    """Return for each parametrised test that failed how often it did with which parameters, the worst ones first.

    Searches without random scenarios are left out.
    """
    tests: dict[str, list[ParameterShare]] = {}
    for each in searches:
        found = PARAMETERS.search(each.node_id)
        if found and each.random["runs"] and found[2].endswith(SEARCH):
            measured = [seen.severity for seen in each.finds if seen.severity is not None]
            impacts = [severity.value or 0.0 for severity in measured if severity.kind == "collision"]
            share = ParameterShare(
                parameters=found[2].removesuffix(SEARCH),
                failing=each.random["at_fault"] + each.random["otherwise"],
                runs=each.random["runs"],
                impact=max(impacts, default=None),
            )
            tests.setdefault(found[1], []).append(share)
    return {
        test: sorted(shares, key=lambda share: (-share.failing / share.runs, share.parameters))
        for test, shares in sorted(tests.items())
        if len(shares) > 1 and any(share.failing for share in shares)
    }


def parameter_lines(searches: Iterable[Search], width: int = WIDTH) -> list[str]:
    """Return a table for each parametrised test: in how many random scenarios it failed, the worst parameters first."""
    lines: list[str] = []
    for test, shares in parameter_shares(searches).items():
        shown = [share for share in shares if share.failing][:MAX_FINDS]
        lines.append(f"{test}, the parameters that fail most first:")
        room = max(len(share.parameters) for share in shown)
        for share in shown:
            text = f"  {share.parameters:{room}}  {share.result}"
            # Wrapping would remove the alignment of rows that fit.
            lines += [text] if len(text) <= width else wrapped_to(text, width)
        for runs in sorted({share.runs for share in shares if not share.failing}, reverse=True):
            rest = [share.parameters for share in shares if share.runs == runs and not share.failing]
            lines += wrapped_to(f"  in none of {runs}{none_text(runs)}: {_listed(rest)}", width)
    return lines


def session_lines(session: Session, *, width: int = WIDTH) -> list[str]:
    """Return the lines of the whole summary of a session; no lines if there is nothing to report."""
    lines = _lines_of_searches(session, width=width)
    for node_id in session.running:
        lines += [node_id, *_wrapped("ended early; its findings are reported", width)]
    lines += replay_lines(session.replays, width)
    lines += [*parameter_lines(session.ended, width), *against_lines(session, width), *worst_lines(session, width)]
    lines += [f"not run: {test}: {WHY_UNNAMED}" for test in session.unnamed]
    if session.left:
        lines.append(f"not run: {plural(len(session.left), 'saved scenario')}: {_listed(session.left, MAX_LEFT)}")
    if any(find.path for find in session.finds):
        lines.append(f"run a single saved scenario with: {session.again}")
    lines += [line for text in session.written for line in text.splitlines()]
    warnings = sorted(set(session.warnings))
    for kind, texts in (("warning", warnings), ("note", session.notes), ("problem", session.problems)):
        for text in texts:
            lines += _wrapped(f"{kind}: {text}", width)
    return list(map(ascii_text, lines))  # escapes names and texts, so that each stays on one line


def further(page: str) -> tuple[str, str]:
    """Return where findings are that a job of a CI does not name: on the page, or in the list that a command prints.

    They are a path or a command, and what follows it in a sentence. ``page`` is empty without a page.
    """
    return (page, " among the files of this job") if page else (command("pytest_pafot", "corpus", "list"), "")


def annotation_lines(sightings: Iterable[Seen], page: str = "") -> list[str]:
    """Return commands by which GitHub Actions shows the worst five findings at their test files.

    Each has the headline, the sentences that explain the finding, and what is known of its decisions. In all of these,
    and in names, what such a command reads as its own marks is escaped. If there are more findings, a notice counts
    them and says where they are: on the report page, whose path is ``page``, or in the list of the corpus.
    """
    ranked = _worst_first(sightings)
    lines = []
    for sighting in ranked[:MAX_ANNOTATED]:
        parts = [sighting.headline, *sighting.observed.sentences, *sighting.on_decisions()]
        text = "%0A".join(ascii_text(each).replace("%", "%25") for each in parts)
        file, title = (
            ascii_text(each).replace("%", "%25").replace(":", "%3A").replace(",", "%2C")
            for each in (sighting.node_id.partition("::")[0], sighting.id)
        )
        lines.append(f"::error file={file},title={title}::{text}")
    left = len(ranked) - MAX_ANNOTATED
    where, rest = further(page)
    where = where if page else f"`{where}`"
    text = ascii_text(f"{plural(left, 'more finding')}: see {where}{rest}").replace("%", "%25")
    return [*lines, f"::notice title=pafot::{text}"] if left > 0 else lines


def _is_quiet(search: Search) -> bool:
    """Return whether a search ran as asked, evaluated something, and nothing failed in it."""
    untested = sum(search.kinds[kind] for kind in UNTESTED)
    is_tested = search.runs > untested or search.reason is Ending.REPLAYS
    is_clean = not (search.failing or search.finds)
    return is_tested and is_clean and not search.reason.is_broken_off


def _lines_of_searches(session: Session, *, width: int) -> list[str]:
    """Summarise all searches of a session: many without a failing run in a line each, and all others whole.

    Warnings and notes of the former are printed once if they differ only in figures, and what searches draw once if it
    is the same.
    """
    searches = session.ended
    quiet = [each for each in searches if _is_quiet(each)]
    quiet = quiet if len(quiet) > MAX_WHOLE else []
    short, lines, drawn = {each.node_id for each in quiet}, list[str](), set[str]()
    for search in searches:
        if search.node_id in short:
            lines.append(f"{search.node_id}: {_figures(search)}, ended: {search.reason}")
        else:
            new = replace(search, drawn="") if search.drawn in drawn else search
            lines += search_lines(new, width=width)
            drawn.add(search.drawn)
    if not quiet:
        return lines
    alike: dict[str, list[tuple[str, str]]] = {}
    for search in quiet:
        texts = [f"warning: {text}" for text in search.warnings]
        texts += [f"note: {text}" for text in (*search.process_notes, *search.notes)]
        for text in texts:
            alike.setdefault(re.sub(r"\d+", "0", text), []).append((search.node_id, text))
    for (node_id, text), *others in alike.values():
        also = f", and likewise in {len(others)} more" if others else ""
        lines += wrapped_to(ascii_text(f"{text} (in {node_id}{also})"), width)
    seeds = ", ".join(map(str, dict.fromkeys(each.base_seed for each in quiet)))
    return [*lines, f"{len(quiet)} searches without a failing run, from {flag('seed')}={seeds}"]


def _listed(names: Sequence[str], limit: int = MAX_FINDS) -> str:
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return f"{', '.join(names[:limit])}{more}"


def _wrapped(text: str, width: int, *, phrases: bool = False) -> list[str]:
    return wrapped_to(f"  {ascii_text(text.strip())}", width, phrases=phrases)
