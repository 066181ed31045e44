"""Names of the user's objects in texts."""

import functools

import pytest

from pytest_pafot import Highway
from pytest_pafot.support.references import described, factory_named, imported, referred_to
from pytest_pafot.world import WorldError

MODULE = """\
import functools


class Planner:
    def __init__(self, *given):
        self.given = given


made = functools.partial(Planner, 1)
number = 5
"""


@pytest.fixture(autouse=True)
def modules(tmp_path, monkeypatch):
    (tmp_path / "named_here.py").write_text(MODULE)
    (tmp_path / "lacks_another.py").write_text("import no_such_library")
    (tmp_path / "exits_here.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize(("reference", "given"), [
    ("named_here:Planner", ()),
    ("named_here:made", (1,)),
    ("named_here:Planner:old.zip", ("old.zip",)),
    (r"named_here:Planner:C:\a b:c", (r"C:\a b:c",)),
    ("named_here:made: ", (1, " ")),
])  # fmt: skip
def test_factory_gets_all_behind_the_second_colon(reference, given):
    assert factory_named(reference)().given == given


@pytest.mark.parametrize(("reference", "message"), [
    ("named_here", "expected module:factory or module:factory:argument, received 'named_here'"),
    ("named_here:", "expected module:factory or module:factory:argument"),
    ("named_here:Planner:", "expected module:factory or module:factory:argument"),
    ("named_here:number", "expected a factory, received 'named_here:number', which has the type int. Name"),
    ("named_here:Planer:x", r"expected a factory in the module named_here, .*\. Did you mean 'named_here:Planner'"),
    ("named_here:zzz", "received 'named_here:zzz'. The module defines Planner. It was"),
    ("named_there:x", r"received 'named_there:x' \(ModuleNotFoundError: .*\. Change to the module's f"),
    ("named_here.py:Planner", r"ModuleNotFoundError.*\. Write named_here:Planner"),
    ("folder/named_here.py:Planner", r"ModuleNotFoundError.*\. Write folder.named_here:Planner"),
    ("/folder/named_here.py:Planner", r"ModuleNotFoundError.*\. Change to the module's folder"),
    (".named_here:Planner", r"received '.named_here:Planner' \(ModuleNotFoundError: .*\. Change to the module's f"),
    ("json:zzz", r"The module defines .* and loads. It was loaded from .*json.__init__.py"),
    ("lacks_another:x", r"whose import raises ModuleNotFoundError: No .*no_such_library.*another.py:1\)\. Correct the"),
    ("exits_here:x", r"whose import raises SystemExit: 3 \(.*exits_here.py:1\)\. Correct the"),
])  # fmt: skip
def test_wrong_name_is_an_error_with_its_cause(reference, message):
    with pytest.raises(ValueError, match=message):
        factory_named(reference)


def test_module_without_a_name_is_none():
    with pytest.raises(
        ValueError, match=r"received ':x' \(ModuleNotFoundError: .*\. Change to the module's f"
    ):
        imported(":x")


def test_place_of_an_error_is_in_the_users_code():
    """What refuses a value is not where to look, nor is the code that a dataclass makes of itself."""
    with pytest.raises(WorldError) as raised:
        Highway(lanes=99)
    here = raised.traceback[0].lineno + 1
    assert described(raised.value).endswith(f"received 99 ({__file__}:{here})")


def test_name_refers_to_any_object_of_a_module():
    assert referred_to("named_here:number") == 5
    assert referred_to("functools:partial") is functools.partial
