"""The plugin's text in the terminal: progress, each finding, why a search fails, and the summary of the session.

The functions turn values into lines of plain ASCII that fit the terminal's width, except for node ids,
paths and the user's own words.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from pytest_pafot.campaign.events import UNTESTED, Ending, Note, Progress, Search
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import described
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.report.session import WHY_UNNAMED, Session
from pytest_pafot.searching.plain import from_plain
from pytest_pafot.support.errors import command, flag, rerun
from pytest_pafot.support.proportions import interval_text, none_text
from pytest_pafot.support.text import ascii_text, fitted_lines, listed, plural, wrapped_to

Event = Progress | Search | Seen | Note
"""What an item says to the record of the session."""

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


def progress_line(progress: Progress, width: int = WIDTH) -> str:
    """Return one line of progress. To fit the width, the start of the node id is left out, then the end of the line.

    If the runs that are left take more than a minute, it says how long they take, and what ends them.
    """
    speed = progress.runs / progress.seconds if progress.seconds > 0 else 0.0
    pace = f"{1 / speed:.0f} s a run" if 0 < speed < 1 else f"{speed:.0f}/s"
    counts = [f"{progress.generation}/{progress.generations} generations"] if progress.generations is not None else []
    counts += [plural(progress.runs, "run") if progress.budget is None else f"{progress.runs}/{progress.budget} runs"]
    seconds, left = progress.left, ""
    if seconds >= MINUTE:
        duration = f"{seconds / HOUR:.1f} h" if seconds >= 2 * HOUR else f"{seconds / MINUTE:.0f} min"
        each = f" at {1000 * progress.decision_seconds:.3g} ms a decision" if progress.decision_seconds else ""
        way_out = "" if progress.is_limited or seconds < LONG else f"; {flag('max_time', LONG)} ends it"
        left = f", about {duration} left{each}{way_out}"
    done = f"{', '.join(counts)}, {progress.failing} failing, {progress.finds} new, {pace}{left}"
    tail = f" {progress.phase or done}"
    room = max(12, width - len(tail) - 8)
    name = ascii_text(progress.node_id)
    name = name if len(name) <= room else f"...{name[3 - room :]}"
    return f"pafot: {name}{tail}"[:width]


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
    seen: Seen, explanation: Iterable[str], *, is_first: bool = False, advice: str = "", width: int = WIDTH
) -> str:
    """Return the section on a new finding in its failure report, without what the failure message says already.

    Args:
        seen: the finding.
        explanation: the lines that explain the run; empty if the failure message contains them.
        is_first: whether it is reported for the first time, so that nothing was tried to simplify it.
        advice: a text that follows the finding's remark.
        width: the width of the terminal in columns.
    """
    fitted = fitted_lines(map(ascii_text, [*explanation, *seen.on_decisions()]), width)
    # A path is not wrapped, so that it can be copied.
    fitted += [ascii_text(f"saved as   {seen.path}")] if seen.path else []
    stop = "" if seen.moment is None else f"; {flag('debug')} stops in the decision at {seen.moment.time:.1f} s"
    rest = [f"run it     pytest FILE{stop}"] if seen.path else [f"not saved  {seen.detail}"]
    against = seen.finding.expect.against
    rest += [f"against    {against}, which passes"] if against else []
    if not is_first:
        rest += [f"shrunk     {how}" for how in shrunk_lines(seen.finding)]
    rest += [f"its file   {seen.detail}"] if seen.path and seen.detail else []
    rest += [f"note       {'; '.join(filter(None, (seen.remark, advice)))}"] if seen.remark else []
    fitted += fitted_lines(map(ascii_text, rest), width)
    if not seen.path and seen.detail != flag("save", "none"):
        fitted += [
            "the file would be:",
            *(ascii_text(f"  {line}") for line in text_of(seen.finding).rstrip().splitlines()),
        ]
    return "\n".join(fitted)


def shrunk_lines(finding: Finding) -> list[str]:
    """Say in a line from what to what a finding shrank; nothing if it did not."""
    if finding.shrunk is None:
        return []
    found, is_minimal = finding.shrunk.before, finding.shrunk.is_minimal
    now = described(finding.scenario, finding.longest_run)
    sizes = [each.split(", ") for each in (found or now, now)]
    changed = [pair for pair in zip(*sizes, strict=True) if pair[0] != pair[1]]
    how = f"from {', '.join(old for old, _ in changed)} to {', '.join(new for _, new in changed)}"
    if not changed:
        how = "to a simpler scenario of the same size" if found else "to nothing simpler so far"
    if not found and is_minimal:
        return []
    return [how if is_minimal else f"{how}, and could be simpler"]


def event_of(kind: str, text: str) -> Event:
    """Return the event of an item from the name of its class and the text of a message."""
    kinds: dict[str, type[Event]] = {each.__name__: each for each in (Progress, Search, Seen, Note)}
    return from_plain(kinds[kind], json.loads(text))


def by_rank(seen: Seen) -> tuple[float | str, ...]:
    """Return the key by which findings are listed, the worst first."""
    return seen.rank


"""A key that sorts findings, the worst first, as in all lists."""


def failure_message(search: Search) -> str:
    """Return why the item of a search fails: its new findings. Each one is also reported as a separate item."""
    firm, flaky = [], []
    for sighting in sorted(search.finds, key=by_rank):
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
    lists = [origin, *drawn]
    failing, counted, checks = (search.random[each] for each in ("at_fault", "runs", "checks"))
    if counted:
        rest = search.random["otherwise"] - checks
        broke = [f"{checks} {'more ' if failing else ''}failed a check"] * bool(checks)
        failed = ", ".join([*broke, *[f"{rest} failed in other ways"] * bool(rest)])
        others = f"; {failed}" if failed else ""
        share = interval_text(failing, counted)
        share = f", {share}" if failing else share.removeprefix("0 %")
        lists.append(f"random scenarios: {failing} of {counted} failed by the ego's fault{share}{others}")
    lines = [
        *_wrapped(_figures(search), width, phrases=True),
        *(line for text in _results(search) for line in _wrapped(text, width)),
        *(line for text in lists for line in _wrapped(text, width, phrases=True)),
    ]
    texts = []
    for id_, count in sorted(search.known.items()):
        texts.append(f"{plural(count, 'run')} {'fails' if count == 1 else 'fail'} like saved-{id_}, not looked at")
    texts += _remarks(search)
    return [search.node_id, *lines, *(line for text in texts for line in _wrapped(text, width))]


def _remarks(search: Search) -> list[str]:
    notes = (*search.process_notes, *search.notes)
    return [*(f"warning: {text}" for text in search.warnings), *(f"note: {text}" for text in notes)]


def _figures(search: Search) -> str:
    kinds, more = search.kinds, search.more_runs
    counts = (
        (more["known"], "not run again"),
        (kinds["failed"], "failing"),
        (kinds["npc"], "npc at fault"),
        (kinds["common"], "failing with both"),
        *((kinds[kind], kind) for kind in UNTESTED),
        (search.no_interaction, "without interaction"),
    )
    parts = [f"{count} {what}" for count, what in counts if count or what == "failing"]
    parts += [] if search.reached is None else [f"NPCs reached {search.reached:.0%} of their goals"]
    several = [plural(search.runs, "run")]
    several += [f"{more[name]} {PURPOSES[name]}" for name in ("shrink", "moment") if more[name]]
    return ", ".join([f"{listed(several)} in {search.seconds:.1f} s", *parts])


def _results(search: Search) -> Iterator[str]:
    """Yield texts on the decisions of the policy, the new findings, and the comparison with a reference.

    Decisions are counted by what they were for, if a search takes long and they take most of the time. New findings are
    counted, since their own reports name them, and those that shrinking made milder are named with their worst run.
    """
    made, finds = search.decisions, sorted(search.finds, key=by_rank)
    if made.total() and search.seconds >= max(MINUTE, EXPENSIVE * made.total()):
        yield listed([f"{made[name]:,} {purpose}" for name, purpose in PURPOSES.items() if made[name]])
    if finds:
        folders = dict.fromkeys(os.path.dirname(each.path) for each in search.finds if each.path)  # noqa: PTH120
        flaky = sum(each.is_flaky for each in finds)
        first = plural(len(finds), "new finding") + (f" ({flaky} flaky)" if flaky else "")
        yield first + (f", saved in {' and '.join(folders)}" if folders else "")
        yield from (f"not saved: {each}" for each in dict.fromkeys(each.detail for each in finds if not each.path))
        yield from [f"{each.id}: {each.on_alike}" for each in finds if each.on_alike][:MAX_FINDS]
    if search.compared:
        yield search.compared
    if search.no_worse:
        names = [f"{id_} ({headline})" if headline else id_ for id_, headline in search.no_worse.items()]
        yield f"fails elsewhere: {_listed(names)}; {flag('pairs', 0)} counts and saves it"


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
    both = (*session.finds, *failing)
    listed = sorted(both, key=lambda each: (each.label != "new" and each.compared != "introduced", *each.rank))
    if len(listed) < 2:
        return []
    lines = [line for each in listed[:MAX_FINDS] for line in wrapped_to(f"  {_measured(each)}", width)]
    more = [f"  ... and {len(listed) - MAX_FINDS} more"] if len(listed) > MAX_FINDS else []
    return ["failures, the worst first:", *lines, *more]


def _measured(seen: Seen) -> str:
    """Return a line with a failure's label, id and parameters, how bad it is, and who is responsible."""
    found = PARAMETERS.search(seen.finding.test)
    name = f"{seen.label}: {seen.id}{f' [{found[2]}]' if found else ''}"
    if seen.severity is None:
        return f"{name} has no measure"
    who = f", {seen.responsible} at fault" if seen.severity.is_fault(seen.responsible) else ""
    return f"{name} {seen.severity}{who}"


def parameter_shares(searches: Iterable[Search]) -> dict[str, list[tuple[float, str, str, int]]]:
    """Return for each parametrised test that failed how often it did with which parameters, the worst ones first.

    Of each set of parameters it returns the negative share of random scenarios in which the test failed, the parameters
    as in the node id, this share and the worst impact in words, and the number of random scenarios. Searches without
    random scenarios are left out.
    """
    tests: dict[str, list[tuple[float, str, str, int]]] = {}
    for each in searches:
        found, runs = PARAMETERS.search(each.node_id), each.random["runs"]
        if found and runs and found[2].endswith(SEARCH):
            measured = [seen.severity for seen in each.finds if seen.severity is not None]
            impact = max((severity.value or 0.0 for severity in measured if severity.kind == "collision"), default=None)
            failing = each.random["at_fault"] + each.random["otherwise"]
            hits = "" if impact is None else f", hits at {impact:.1f} m/s"
            told = f"fails in {failing} of {runs} random scenarios{hits}"
            tests.setdefault(found[1], []).append((-failing / runs, found[2].removesuffix(SEARCH), told, runs))
    return {
        test: sorted(shares)
        for test, shares in sorted(tests.items())
        if len(shares) > 1 and any(share for share, *_ in shares)
    }


def parameter_lines(searches: Iterable[Search], width: int = WIDTH) -> list[str]:
    """Return a table for each parametrised test: in how many random scenarios it failed, the worst parameters first."""
    lines: list[str] = []
    for test, shares in parameter_shares(searches).items():
        shown = [(parameters, told) for share, parameters, told, _ in shares if share][:MAX_FINDS]
        lines.append(f"{test}, the parameters that fail most first:")
        room = max(len(parameters) for parameters, _ in shown)
        for parameters, told in shown:
            text = f"  {parameters:{room}}  {told}"
            # Wrapping would remove the alignment of rows that fit.
            lines += [text] if len(text) <= width else wrapped_to(text, width)
        passed: dict[int, list[str]] = {}
        for share, parameters, _, runs in shares:
            if not share:
                passed.setdefault(runs, []).append(parameters)
        for runs, rest in sorted(passed.items(), reverse=True):
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
        lines.append(f"run a single saved scenario with: {rerun(['pytest', 'FILE'], os.environ, saved='ID')}")
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
    ranked = sorted(sightings, key=by_rank)
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
        for text in _remarks(search):
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
