"""The bisection of commits, and commits of a policy in a worktree next to the present files."""

import math
import os
import random
import subprocess
import sys

import pytest

from pytest_pafot.extras.revisions.commits import History, halved
from pytest_pafot.support.errors import RequestError

LOCAL = ("-c", "protocol.file.allow=always")
"""The option with which git clones a submodule from a folder."""


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Return a repository with two commits of a policy; the second renames a part."""
    root = tmp_path / "project"
    for name, text in {"policy/net.py": "1", "policy/old.py": "1", "test_it.py": "1", ".gitignore": "*.npz"}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "Ann")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "ann@example.org")
    git(root, "init", "-q", "-b", "main")
    git(root, "add", ".")
    git(root, "commit", "-qm", "First")
    (root / "policy/old.py").rename(root / "policy/new.py")
    git(root, "add", ".")
    git(root, "commit", "-qm", "Second")
    return root


def git(root, *arguments):
    return subprocess.run(["git", "-C", root, *arguments], check=True, capture_output=True, text=True).stdout


def state_of(root):
    """Return everything that a command must not change: files, the index, branches and worktrees."""
    files = {path: path.read_bytes() for path in root.rglob("*") if path.is_file() and ".git" not in path.parts}
    told = [git(root, "--no-optional-locks", *each.split()) for each in ("status", "worktree list", "for-each-ref")]
    return files, (root / ".git/index").read_bytes(), (root / ".git/HEAD").read_bytes(), told


def names_in(tree):
    return {path.relative_to(tree).as_posix() for path in tree.rglob("*") if path.is_file() and path.name != ".git"}


def test_halving_finds_first_failure_and_preceding_untestable_commits():
    rng = random.Random(5)
    for count in range(1, 40):
        first = rng.randrange(count)
        unjudged = {place for place in range(count - 1) if rng.random() < rng.choice((0.0, 0.1, 0.6))}
        tried = []

        def passes(commit, first=first, unjudged=unjudged, tried=tried):
            tried.append(int(commit))
            return None if int(commit) in unjudged else int(commit) < first

        left = [int(commit) for commit in halved([str(place) for place in range(count)], passes)]
        judged = [place for place in range(count) if place not in unjudged]
        passing = max((place for place in judged if place < first), default=-1)
        assert left == list(range(passing + 1, min(place for place in judged if place >= first) + 1))
        assert len(tried) == len(set(tried))
        if not unjudged:
            assert len(tried) <= math.ceil(math.log2(count))


def test_halving_skips_a_row_of_untestable_commits():
    tried = []

    def passes(commit):
        tried.append(commit)
        return None if 30 <= int(commit) < 70 else int(commit) < 90

    assert halved([f"{place}" for place in range(100)], passes) == ["90"]
    assert len(tried) < 15


def test_worktree_combines_current_files_with_a_committed_policy(repository):
    (repository / "test_it.py").write_text("not committed")
    (repository / "helper.py").write_text("new")
    (repository / "weights.npz").write_text("ignored")
    (repository / "ignored.npz").write_text("ignored")
    (repository / "policy/net.py").write_text("not committed")
    (repository / "policy/more.py").write_text("new")
    before = state_of(repository)
    history = History.of(["../project/policy"], repository)
    first, second = git(repository, "rev-list", "--reverse", "main").split()
    with history.worktree(["weights.npz"]) as tree:
        now = {".gitignore", "test_it.py", "helper.py", "weights.npz", "policy/net.py"}
        for commit, name in ((first, "old"), (second, "new"), (first, "old")):
            history.put(tree, commit)
            assert names_in(tree) == {*now, f"policy/{name}.py"}
        assert (tree / "test_it.py").read_text() == "not committed"
        assert (tree / "policy/net.py").read_text() == "1"
        (tree / "test_it.py").write_text("of the session")
    assert not tree.parent.exists()
    assert state_of(repository) == before


def test_worktree_copies_links_and_never_writes_through_them(repository, tmp_path):
    (tmp_path / "outside").mkdir()
    (repository / "data").symlink_to(tmp_path / "outside")
    git(repository, "add", "data")
    git(repository, "commit", "-qm", "Link")
    (repository / "data").unlink()
    (repository / "data").mkdir()
    (repository / "data/file").write_text("now")
    (repository / "link").symlink_to("data/file")
    with History.of(["policy"], repository).worktree([]) as tree:
        assert (tree / "data/file").read_text() == (tree / "link").read_text() == "now"
        assert (tree / "link").is_symlink()
    assert not list((tmp_path / "outside").iterdir())


def test_git_hooks_and_environment_variables_are_ignored(repository, monkeypatch, tmp_path):
    hook = repository / ".git/hooks/post-checkout"
    hook.parent.mkdir(exist_ok=True)
    hook.write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
    hook.chmod(0o755)
    before = state_of(repository)
    with monkeypatch.context() as caller:
        caller.setenv("GIT_DIR", str(repository / ".git"))
        caller.setenv("GIT_INDEX_FILE", str(repository / ".git/index"))
        caller.setenv("GIT_WORK_TREE", str(repository))
        history = History.of(["policy"], repository)
        with history.worktree([]) as tree:
            history.put(tree, history.named("main~1"))
    assert not (tmp_path / "ran").exists()
    assert state_of(repository) == before


def test_revision_has_all_files_of_its_commit_and_ignored_copies(repository):
    (repository / "test_it.py").write_text("not committed")
    (repository / "models").mkdir()
    (repository / "models/net.npz").write_text("ignored")
    (repository / "models/old.py").write_text("not committed")
    (repository / "policy/net.py").write_text("not committed")
    before = state_of(repository)
    history = History.of([], repository)
    with history.revision(history.named("main~1"), ["models", "policy/net.py"]) as tree:
        committed = {".gitignore", "test_it.py", "policy/net.py", "policy/old.py"}
        assert names_in(tree) == {*committed, "models/net.npz", "models/old.py"}
        assert (tree / "policy/net.py").read_text() == (tree / "test_it.py").read_text() == "1"
    assert not tree.parent.exists()
    assert state_of(repository) == before


def test_revision_has_its_submodules_as_already_cloned(repository, tmp_path, monkeypatch):
    for name, folder in (("inner", tmp_path / "inner"), ("outer", tmp_path / "outer")):
        folder.mkdir()
        git(folder, "init", "-q", "-b", "main")
        (folder / f"{name}.py").write_text("1")
        if name == "outer":
            git(folder, *LOCAL, "submodule", "--quiet", "add", str(tmp_path / "inner"), "a b")
        git(folder, "add", "-A")
        git(folder, "commit", "-qm", "First")
    git(repository, *LOCAL, "submodule", "--quiet", "add", str(tmp_path / "outer"), "policy/sub")
    git(repository, *LOCAL, "submodule", "--quiet", "update", "--init", "--recursive")
    git(repository, "commit", "-qm", "Submodule")
    (repository / "policy/sub/outer.py").write_text("2")
    git(repository / "policy/sub", "commit", "-qam", "Second")
    git(repository, "commit", "-qam", "Second of it")
    history = History.of([], repository)
    with history.revision(history.named("main~1"), []) as tree:
        assert (tree / "policy/sub/outer.py").read_text() == "1"
        assert (tree / "policy/sub/a b/inner.py").read_text() == "1"
    with history.revision(history.named("main"), []) as tree:
        assert (tree / "policy/sub/outer.py").read_text() == "2"
    git(tmp_path, "clone", "-q", str(repository), "clone")
    clone = History.of([], tmp_path / "clone")
    with clone.revision(clone.named("main~1"), []) as tree:  # where nothing is cloned now either
        assert not list((tree / "policy/sub").iterdir())
    (tmp_path / "clone/policy/sub/outer.py").write_text("3")
    expected = r"expected the submodule policy/sub to be cloned with its commit .*run `git -C policy/sub fetch` first"
    with pytest.raises(RequestError, match=expected), clone.revision(clone.named("main~1"), []):
        pass
    assert state_of(repository)[3][1].count("\n") == 1


def test_worktree_of_a_killed_process_is_removed_by_the_next(repository):
    history = History.of([], repository)
    with history.revision("main", []) as tree:
        with history.revision("main", []) as other:
            assert tree.exists()  # its process lives
            assert other.exists()
        code = "import os\nfrom pathlib import Path\nfrom pytest_pafot.extras.revisions.commits import History\n"
        code += f"with History.of([], Path({str(repository)!r})).revision('main', []) as tree:\n    os._exit(9)\n"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
        assert git(repository, "worktree", "list").count("\n") == 3
        with history.revision("main", []):
            assert git(repository, "worktree", "list").count("\n") == 3
    assert git(repository, "worktree", "list").count("\n") == 1


def test_folder_that_git_does_not_list_is_removed_when_old(repository, tmp_path, monkeypatch):
    places = tmp_path / "places"
    for name in ("pafot-tree-old", "pafot-tree-new", "other"):
        (places / name).mkdir(parents=True)
    (places / "pafot-tree-link").symlink_to(repository)
    for name in ("pafot-tree-old", "other"):
        os.utime(places / name, (0, 0))
    os.utime(places / "pafot-tree-link", (0, 0), follow_symlinks=False)
    monkeypatch.setattr("tempfile.tempdir", str(places))
    with History.of([], repository).revision("main", []):
        pass
    assert sorted(each.name for each in places.iterdir()) == ["other", "pafot-tree-link", "pafot-tree-new"]


def test_worktree_whose_folder_is_gone_is_forgotten(repository):
    history = History.of([], repository)
    code = "import os, shutil\nfrom pathlib import Path\nfrom pytest_pafot.extras.revisions.commits import History\n"
    code += f"with History.of([], Path({str(repository)!r})).revision('main', []) as tree:\n"
    code += "    shutil.rmtree(tree.parent)\n    os._exit(9)\n"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    assert git(repository, "worktree", "list").count("\n") == 2
    with history.revision("main", []):
        assert git(repository, "worktree", "list").count("\n") == 2
    assert git(repository, "worktree", "list").count("\n") == 1


def test_policy_in_a_submodule_is_put_commit_by_commit(repository, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    git(inner, "init", "-q", "-b", "main")
    git(repository, "rm", "-rq", "policy")
    for number, files in enumerate((["a.py"], ["a.py", "deep/b.py"], ["c.py"])):
        git(inner, "rm", "-rq", "--ignore-unmatch", ".")
        for name in files:
            (inner / name).parent.mkdir(parents=True, exist_ok=True)
            (inner / name).write_text(str(number))
        git(inner, "add", ".")
        git(inner, "commit", "-qm", str(number))
        if number == 0:
            git(repository, *LOCAL, "submodule", "--quiet", "add", "--name", "named", str(inner), "the policy")
        git(repository / "the policy", "pull", "-q", "origin", "main")
        git(repository, "add", ".")
        git(repository, "commit", "-qm", str(number))
    (repository / "the policy/net.npz").write_text("weights")
    before = state_of(repository)
    history = History.of(["the policy/a.py"], repository).with_whole_submodules("main~2", "main")
    assert history.paths == ("the policy",)
    assert history.between("main~2", "main") == git(repository, "rev-list", "--reverse", "main~2..main").split()
    with history.worktree(["the policy/net.npz"]) as tree:
        for commit, names in (("main~2", ["a.py"]), ("main", ["c.py"]), ("main~1", ["a.py", "deep/b.py"])):
            history.put(tree, commit)
            assert names_in(tree / "the policy") == {"net.npz", *names}
        assert (tree / "the policy/deep/b.py").read_text() == "1"
        history.put(tree, "main~3")  # before the submodule
        assert not (tree / "the policy").exists()
        history.put(tree, "main~2")
        assert names_in(tree / "the policy") == {"a.py"}
    assert state_of(repository) == before
    git(tmp_path, "clone", "-q", str(repository), "clone")
    clone = History.of(["the policy"], tmp_path / "clone")
    expected = r"expected the submodule the policy to be cloned .*run `git submodule update --init 'the policy'` first"
    with clone.worktree([]) as tree, pytest.raises(RequestError, match=expected):
        clone.put(tree, "main")
    git(tmp_path / "clone", *LOCAL, "submodule", "--quiet", "update", "--init", "the policy")
    with clone.worktree([]) as tree:
        clone.put(tree, "main")
        assert names_in(tree / "the policy") == {"c.py"}


def test_object_that_is_no_commit_is_named(repository):
    history = History.of([], repository)
    with pytest.raises(RequestError, match=r"received 'HEAD\^\{tree\}', which is a tree; name the commit itself"):
        history.named("HEAD^{tree}")
    with pytest.raises(RequestError, match="received 'nothing', which does not exist in"):
        history.named("nothing")
    with pytest.raises(RequestError, match=r"received 'a\\x00b', which does not exist in"):
        history.named("a\0b")


def test_folder_without_a_repository_has_a_way_out(tmp_path):
    with pytest.raises(RequestError, match=r"received .*not a git repository.*; run in a clone, or copy the other"):
        History.of([], tmp_path)


def test_file_replaces_a_pointer_of_git_lfs_on_request(repository):
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 7\n"
    (repository / "net.bin").write_text(pointer)
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "Weights")
    (repository / "net.bin").write_text("weights")
    history = History.of([], repository)
    assert [history.has("main", name) for name in ("net.bin", "test_it.py", "policy", "none")] == [
        False,
        True,
        True,
        False,
    ]
    for extra, expected in (([], pointer), (["net.bin"], "weights")):
        with history.revision("main", extra) as tree:
            assert (tree / "net.bin").read_text() == expected


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_repository_that_cannot_be_written_has_a_way_out(repository):
    history = History.of([], repository)
    (repository / ".git").chmod(0o500)
    try:
        with pytest.raises(RequestError, match="copy the repository to a folder that you can write, and run there"):
            history.revision("main", []).__enter__()
    finally:
        (repository / ".git").chmod(0o700)


@pytest.mark.parametrize("end", [KeyboardInterrupt, SystemExit])
def test_the_worktree_is_removed_whatever_ends_the_search(repository, end):
    before = state_of(repository)
    with pytest.raises(end), History.of(["policy"], repository).worktree([]) as tree:
        raise end
    assert not tree.exists()
    assert state_of(repository) == before


def test_what_is_no_history_is_told(repository, tmp_path, monkeypatch):
    history = History.of(["policy"], repository)
    for revision in ("nothing", "--help", "main:policy", "-"):
        with pytest.raises(RequestError, match="expected a commit, a branch or a tag, received"):
            history.named(revision)
    with pytest.raises(RequestError, match=r"--policy: expected a path inside the repository .*, received \.\./x"):
        History.of(["../x"], repository)
    with pytest.raises(RequestError, match="not a git repository"):
        History.of(["policy"], tmp_path)
    monkeypatch.setenv("PATH", os.fspath(tmp_path))
    with pytest.raises(RequestError, match="expected the program git, received none on the PATH"):
        History.of(["policy"], repository)
