"""The test on several people: from scenes to metrics.json and report.md."""

import json

import numpy as np
import pytest
import yaml

from composed import compose
from ghpt.commands.people import PeopleResult, test_people
from ghpt.config import build
from ghpt.data.datasets.people import People
from ghpt.errors import GhptConfigError
from ghpt.models.estimators.classical import Linear

SCENES = {
    "pair": {
        "cameras": [3, 8, 12, 18],
        "frames": 24,
        "rate_hz": 30.0,
        "people": [
            {"action": "Walking", "place": [0, 0]},
            {"action": "Greeting", "place": [700, 0], "there": [[0.5, 1.0]]},
        ],
    }
}
LINEAR = {"linear": {"_target_": f"{Linear.__module__}.{Linear.__name__}"}}


def settings(pytestconfig, **changed):
    detector = pytestconfig.rootpath / "conf" / "detector" / "human36m.yaml"
    synthetic = {"seed": 0, "detector": yaml.safe_load(detector.read_text())}
    return {
        "_target_": f"{People.__module__}.{People.__name__}",
        "name": "people",
        "root": None,
        "evaluate": "test",
        "synthetic": synthetic,
        "scenes": SCENES,
    } | changed


@pytest.fixture(scope="module")
def result(pytestconfig, tmp_path_factory) -> tuple[PeopleResult, dict]:
    output = tmp_path_factory.mktemp("people")
    data = settings(pytestconfig)
    trajectory = compose("test")["trajectory"]
    trainer = {"enable_model_summary": False}
    found = test_people(data, LINEAR, trajectory, trainer, None, 0, False, output)
    assert (output / "report.md").exists()
    return found, json.loads((output / "metrics.json").read_text())


def test_two_people_are_found_followed_and_placed(result):
    found, written = result
    (scene,) = found.scenes
    scores = scene.scores["linear"]
    assert (scene.people, scene.found, scores.switches) == (2, 2, 0)
    assert scores.recall == pytest.approx(100, abs=2)
    assert scores.idf1 == pytest.approx(100, abs=2)
    assert scores.mpjpe < 60
    assert written["estimators"]["linear"] == scores.plain()


def test_the_trajectory_places_limbs_that_one_view_sees(result):
    """It is what the terminal shows of each scene."""
    found, _ = result
    assert found.headline == "trajectory"
    assert found.scores["trajectory"].pcp > found.scores["linear"].pcp


def test_a_recording_is_of_its_scene_and_seed_alone(pytestconfig):
    one, again = (build(settings(pytestconfig), "data").recording("pair") for _ in range(2))
    np.testing.assert_array_equal(one.detections.points.pixels, again.detections.points.pixels)
    np.testing.assert_array_equal(one.owner, again.owner)
    assert one.present.sum(0).tolist() == [24, 12]
    assert (one.detected_views()[~one.present] == 0).all()


def test_who_is_nearer_hides_who_is_behind(pytestconfig):
    """Beside another, a person loses joints that alone they have."""
    alone = {"pair": SCENES["pair"] | {"people": SCENES["pair"]["people"][:1]}}
    both = build(settings(pytestconfig), "data").recording("pair")
    single = build(settings(pytestconfig, scenes=alone), "data").recording("pair")
    joints = [r.detections.points.valid[r.owner == 0].sum() for r in (both, single)]
    assert 0.7 * joints[1] < joints[0] < joints[1]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"root": "/data"}, "data.root"),
        ({"scenes": {}}, "data.scenes"),
        ({"scenes": {"pair": SCENES["pair"] | {"people": []}}}, "people"),
        ({"scenes": {"pair": SCENES["pair"] | {"frames": 0}}}, "frames"),
        ({"scenes": {"pair": SCENES["pair"] | {"rooms": 1}}}, "rooms"),
        ({"scenes": {"pair": SCENES["pair"] | {"people": [{"action": "Walking"}]}}}, "place"),
    ],
)
def test_bad_scenes_are_named(changed, words, pytestconfig):
    with pytest.raises(GhptConfigError, match=words):
        build(settings(pytestconfig, **changed), "data")


def test_a_checkpoint_is_refused(pytestconfig, tmp_path):
    with pytest.raises(GhptConfigError, match="ckpt"):
        test_people(settings(pytestconfig), LINEAR, None, {}, "last.ckpt", 0, False, tmp_path)


def test_nothing_is_trained_on_people(pytestconfig):
    with pytest.raises(GhptConfigError, match=r"test\.py"):
        build(settings(pytestconfig), "data").bind(None)
