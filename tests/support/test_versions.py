"""The cores and limits that the operating system gives this process, in a folder in place of its root."""

import os

import pytest

from pytest_pafot.support.process import cores, cpu_limits


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Return a function that writes a cgroup and limits by their paths, for a process that may use eight cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)

    def write(group, **limits):
        files = {"proc/self/cgroup": f"4:memory:/elsewhere\n0::{group}\n"}
        files |= {
            f"sys/fs/cgroup/{path.replace('__', '/')}/cpu.max": text
            for path, text in limits.items()
        }
        for path, text in files.items():
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(text)
        return tmp_path

    return write


@pytest.mark.parametrize(("quota", "count"), [
    ("max 100000\n", 8),
    ("250000 100000\n", 3),  # a part of a core counts
    ("20000 100000\n", 1),
    ("1600000 100000\n", 8),
    (f"{10**400} 1\n", 8),  # more than a float can be
    ("300000\n", 3),  # of the usual period
])  # fmt: skip
def test_a_quota_limits_the_cores(machine, quota, count):
    assert cores(machine("/job", job=quota)) == count


def test_the_smallest_quota_of_a_cgroup_and_those_around_it_counts(machine):
    root = machine("/slurm/job_7/step_0", slurm="600000 100000\n", slurm__job_7="400000 200000\n")
    assert cores(root) == 2
    assert sorted(cpu_limits(root)) == [[400000, 200000], [600000, 100000]]


def test_a_container_has_its_limits_at_the_root_of_its_cgroups(machine):
    assert cores(machine("/", **{"": "200000 100000\n"})) == 2


@pytest.mark.parametrize(
    "text", ["", "garbage", "0 100000\n", "-1 100000\n", "100000 0\n", "1e5 100000\n", "\xff"]
)
def test_a_file_that_states_no_limit_is_left_out(machine, text):
    root = machine("/job", job=text)
    assert cores(root) == 8
    assert list(cpu_limits(root)) == []


@pytest.mark.usefixtures("machine")
def test_a_system_without_cgroups_has_the_cores_of_the_affinity(tmp_path):
    assert cores(tmp_path) == 8


def test_cores_without_an_affinity_are_those_of_the_machine(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert cores(tmp_path) == 5
