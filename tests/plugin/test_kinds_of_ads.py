"""Every kind of ADS can be searched, and what it raises is a finding."""

import textwrap

from pytest_pafot.corpus.reader import load
from tests.helpers.sessions import section

VEHICLES = {
    "mark": """
        from highway_env.vehicle.behavior import IDMVehicle

        @pafot.search(SHORT, ads=IDMVehicle)  # stop_after=1
        def test_vehicle(run):
            assert run.duration < 1
    """,
    "world": """
        from highway_env.vehicle.behavior import IDMVehicle

        @pafot.search(ads=IDMVehicle, world=pafot.World("highway-v0", duration=2.0), genes=1)  # stop_after=1
        def test_vehicle(run):
            assert run.duration < 1
    """,
}


def test_vehicle_class_works_in_search_and_replay(project, in_highway_env):
    for given, source in VEHICLES.items():
        project.write(textwrap.dedent(source), name=f"test_{given}")
    result = project.run("--pafot-shrink-runs=5")
    result.assert_outcomes(failed=2 * len(VEHICLES))
    assert sorted(name.split("/")[1] for name in project.files) == sorted(
        f"test_{given}" for given in VEHICLES
    )
    assert "flaky" not in result.stdout.str()
    project.run(runs=0).assert_outcomes(failed=len(VEHICLES), skipped=len(VEHICLES))


RAISING = """
class Panic(BaseException): pass

def drive(observation):
    if observation.time > 1:
        RAISE
    return 0.0, 0.0

@pafot.search(SHORT, ads=lambda: drive, shrink_runs=0)
def test_drive(run): pass
"""

RAISED = {
    "return {}['missing key'], 0.0": "KeyError",
    "pytest.skip('no GPU')": "Skipped",
    "pytest.importorskip('no_such_module')": "Skipped",
    "pytest.xfail('never')": "XFailed",
    "pytest.fail('never')": "Failed",
    "raise Panic('native code')": "Panic",
    "raise GeneratorExit": "GeneratorExit",
    "raise BaseExceptionGroup('many', [Panic()])": "BaseExceptionGroup",
    "pafot.reject()": "Rejected",
    "pytest.exit('green', returncode=0)": "Exit",
}


def test_any_exception_of_ads_is_saved_and_replayed(project, in_highway_env):
    for number, statement in enumerate(RAISED):
        source = RAISING.replace("RAISE", statement).replace("test_drive", f"test_drive_{number}")
        project.write(source, name=f"test_{number}")
    result = project.run(runs=2)
    result.assert_outcomes(failed=2 * len(RAISED))
    for number, failure in enumerate(RAISED.values()):
        (name,) = [name for name in project.files if f"/test_drive_{number}/" in name]
        finding = load(project.path / name)
        assert finding.expect.failure == failure
        assert finding.id.startswith("ads-error-")
        assert f" s: {failure}" in section(result, f"test_drive_{number}[saved-{finding.id}]")
    assert sum(" 2 of 2 " in line for line in result.outlines) == len(RAISED)
    project.run(runs=0).assert_outcomes(failed=len(RAISED), skipped=len(RAISED))
