"""``--pafot-merge``: each test adds the findings of other machines to its corpus, instead of searching."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.commands.results import read_results
from pytest_pafot.corpus.layout import counterparts, files_in, folder_of_test, folders_below, relative
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.collection import is_search
from pytest_pafot.plugin.marks import arguments_of
from pytest_pafot.plugin.node_ids import base_id, qualified_name
from pytest_pafot.plugin.option_sources import corpus_name
from pytest_pafot.plugin.unrun import UNRUN
from pytest_pafot.support.errors import RequestError, flag

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request
    from pytest_pafot.execution.scenario_pool import Job
    from pytest_pafot.model.scenario import Scenario

MERGE = BY_NAME["merge"].key

MERGES: pytest.StashKey[dict[str, list[Path]]] = pytest.StashKey()
"""The folders in other corpora that hold a test's files, by the node id of the test. Only a merging session has it."""


class Merging:
    """Hooks of a merging session: they drop all items except searches, and find the test of each folder to merge."""

    def __init__(self, config: pytest.Config) -> None:
        self._roots = [config.invocation_params.dir / given for given in config.getoption(MERGE)]
        for root in self._roots:
            if not root.is_dir():
                expected = "expected the folder of a corpus"
                raise pytest.UsageError(f"{flag('merge')}: {expected}, received {root}, which is no folder")
        config.stash[MERGES] = {}

    # First, before tests are selected: the files of a deselected test would be reported as files without a test.
    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Drop all items except searches. Report folders of other corpora that match no test, or more than one."""
        others = [item for item in items if not is_search(item)]
        items[:] = [item for item in items if is_search(item)]
        config.hook.pytest_deselected(items=others)
        names, unmerged = {}, config.stash[UNRUN].unmerged
        unmerged.update(_not_brought(self._roots, config.rootpath))
        for item in items:
            corpus = corpus_name(config, arguments_of(item) or {})
            if corpus is not None:
                names[folder_of_test(item.path, qualified_name(item), corpus, config.rootpath)] = base_id(item)
        for root in self._roots:
            folders = folders_below(root)
            if not folders and not any(root.rglob("*.json")):  # a machine that found nothing has results
                why = "it has neither saved scenarios nor results, pafot.json; see whether its machine has searched"
                unmerged[relative(root, config.rootpath)] = why, False
            for folder in folders:
                tests = [names[own] for own in counterparts(folder.relative_to(root), names)]
                if len(tests) == 1:
                    config.stash[MERGES].setdefault(tests[0], []).append(folder)
                    continue
                why = (
                    f"it matches {' and '.join(tests)}; give the folder above it" if tests else "no test was collected"
                )
                unmerged[relative(folder, config.rootpath)] = why, False


def _not_brought(roots: Iterable[Path], rootpath: Path) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield the new findings that results in some folders name as saved, if their file is neither there nor here."""
    brought = {file.name for root in roots for folder in folders_below(root) for file in files_in(folder)}
    for results in sorted(file for root in roots for file in root.rglob("pafot.json")):
        try:
            findings = read_results(results).findings
        except RequestError:  # something else of this name
            continue
        for file in [each["file"] for each in findings if each.get("status") == "new" and each.get("file")]:
            if Path(file).name not in brought and not (rootpath / file).is_file():
                why = f"{relative(results, rootpath)} names it as a new finding; bring the corpus of its machine along"
                yield file, (why, True)


def run_merge(item: pytest.Function, request: Request) -> None:
    """Merge the files of other corpora into the corpus of a test; fail if the user must correct one of the files."""
    __tracebackhide__ = True
    from pytest_pafot.campaign.merging import merge  # noqa: PLC0415  (imports the simulation)
    from pytest_pafot.campaign.replays import Replays  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import harness_of  # noqa: PLC0415

    harness = harness_of(item, request)
    folders = item.config.stash[MERGES].get(harness.node_id, [])
    if not folders:
        return
    merged = merge(Replays(harness=harness, in_own_session=_refuse), folders, item.nodeid)
    for leftover in harness.left_behind(item.nodeid):
        leftover.discard()
    messages.send(item, "merge", {"text": "\n".join(merged.lines)})
    if merged.errors:
        pytest.fail("\n".join(merged.errors), pytrace=False)


def _refuse(file: Path, job: Job, scenario: Scenario) -> None:
    """Raise an error instead of replaying in a separate session, which could not replay a file of another project."""
    raise RequestError(
        f"{file}: expected an ADS that can be sent to another process, since the scenario may end the process that "
        f"runs it, received an ADS that cannot be pickled; use {flag('isolate')} and an ADS that can be pickled, or "
        "merge on a system that forks processes"
    )
