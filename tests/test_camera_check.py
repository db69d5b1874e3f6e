"""The camera check: every breakage is named, a good rig is left alone, and what is mended is right
again.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import sizes
from composed import compose
from ghpt.calibration.check.agreement import agreement, errors, median
from ghpt.calibration.check.breakages import BREAKAGES, POSE_BREAKAGES, Case
from ghpt.calibration.check.camera_check import merge_steps
from ghpt.calibration.check.evidence import choose, gather
from ghpt.calibration.check.resection import resect
from ghpt.calibration.check.setup import RayCache, setup_of
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.mistakes import exchange_views
from ghpt.config import build
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.people.persons import person_sequence
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.lens import distort
from ghpt.skeleton import JOINTS
from rigs_with_people import people
from single_person import SinglePerson

ROOT = Path(__file__).resolve().parents[1]


@cache
def camera_check(**changed):
    config = compose("cameras")["camera_check"]
    return build(config | {"frames": 24, "shift": 12} | changed, "camera_check")


def check(spoilt: Case):
    """What the camera check says of a case."""
    return camera_check()(spoilt.evidence, spoilt.setup)


@cache
def case(views: int = 4, max_shift: int = 2, noise: float = 0.006, frames: int = 90) -> Case:
    """A person walking before Panoptic's cameras, through their lenses; noise in sizes of the
    person, about.
    """
    rig = panoptic_rig((10, 12, 16, 18, 22, 6)[:views])
    walk = draw_motion(3, "P", "P/Walking", "Walking", frames, 25.0)
    points = torch.from_numpy(np.stack([walk[..., 0], -walk[..., 2], walk[..., 1]], axis=-1))
    pixels, depth = project(rig.cameras.index(None), points)
    bent = distort(pixels.transpose(0, 1).flatten(1, 2), rig.cameras.K, rig.distortion)
    bent = bent.unflatten(1, points.shape[:2]).transpose(0, 1)
    valid = (depth > 0) & (bent >= 0).all(-1) & (bent <= rig.size[:, None] - 1).all(-1)
    random = torch.randn(
        bent.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    file = rig
    found = choose(
        rig.names,
        (bent + 500 * noise * random).numpy(),
        valid.numpy(),
        np.arange(frames),
        20,
        max_shift,
        "",
    )
    return Case(found, setup_of(file))


@pytest.mark.parametrize("views", [2, 3, 4, 6] if sizes.NIGHTLY else [2, 4])
def test_a_good_rig_has_nothing_wrong(views):
    result = check(case(views))
    assert result.findings == ()
    assert 1500 < result.stature < 2000
    assert float(result.error_px.max()) < 10


@cache
def checked(kind):
    return check(BREAKAGES[kind].spoil(case(max_shift=12 if kind in ("late", "early") else 2)))


PUSHED = (
    "camera_to_world",
    "late",
    "lens_missing",
    "metres",
    "moved",
    "sides_swapped",
    "turned_90",
)
"""One of each sort; all the others, two seconds each, at night.

Exchanged cameras are in tests/test_commands_agree.py, a wrong resolution in
tests/reliability/test_bad_rigs.py.
"""


def tried(kinds):
    """Those of the kinds that are tried, in their order."""
    return [kind for kind in kinds if sizes.NIGHTLY or kind in PUSHED]


@pytest.mark.parametrize(
    "kind", tried(sorted(set(BREAKAGES) - {"one_axes_flipped", "one_camera_to_world_flipped"}))
)
def test_every_breakage_is_found_and_nothing_else(kind):
    names = case().evidence.names
    assert [finding.code for finding in checked(kind).findings] == [BREAKAGES[kind].code]
    finding = checked(kind).findings[0]
    assert finding.cameras == () if BREAKAGES[kind].of_all else names[-1] in finding.cameras
    assert finding.mended
    assert float(checked(kind).error_px.max()) < 10


def test_numbers_of_the_mistakes_are_those_that_were_made():
    numbers = {
        "moved": pytest.approx(3.0, abs=1.0),  # 100 mm look like a rotation too
        "late": 5,
        "early": -10,
        "metres": 1000,
        "centimetres": 10,
        "one_metres": 1000,
        "resolution": pytest.approx(0.5),
        "turned_90": 90,
        "one_turned_180": 180,
    }
    expected = {kind: numbers[kind] for kind in tried(numbers)}
    assert {kind: checked(kind).findings[0].value for kind in expected} == expected


def test_mended_poses_are_the_true_ones():
    setup = case().setup
    for kind in tried((*POSE_BREAKAGES, "metres", "one_metres")):
        mended = checked(kind).setup
        torch.testing.assert_close(mended.R, setup.R, rtol=0, atol=1e-9)
        torch.testing.assert_close(mended.t, setup.t, rtol=0, atol=1e-6)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_camera_shows_the_turned_image(quarters):
    rig = human36m_rig("S9")  # with tangential distortion
    setup = setup_of(rig)
    turned = setup.turn_images((0,), 90 * quarters)
    point = torch.tensor([[[300.0, -200.0, 1500.0]]], dtype=torch.float64)

    def shown(of):
        pixels, _ = project(Cameras(of.K, of.R, of.t), point[0])
        return distort(pixels, of.K, of.lens)[0, 0]

    u, v = shown(setup)
    width, height = setup.width[0], setup.height[0]
    expected = {1: (height - 1 - v, u), 2: (width - 1 - u, height - 1 - v), 3: (v, width - 1 - u)}
    torch.testing.assert_close(shown(turned), torch.stack(expected[quarters]))
    back = turned.turn_images((0,), 360 - 90 * quarters)
    torch.testing.assert_close(back.K, setup.K)
    torch.testing.assert_close(back.lens, setup.lens)
    assert (back.width, back.height) == (setup.width, setup.height)


def test_two_mistakes_in_one_recording_are_both_found():
    spoilt = BREAKAGES["late"].spoil(BREAKAGES["camera_to_world"].spoil(case(max_shift=12)))
    result = check(spoilt)
    assert [finding.code for finding in result.findings] == ["camera_to_world", "out_of_sync"]


def test_the_unit_of_the_world_does_not_change_who_agrees():
    good = case()
    evidence, setup = good.evidence, good.setup
    estimator = camera_check().thresholds.estimator
    one = agreement(RayCache(evidence), setup, estimator, 0.05, 100)
    other = agreement(RayCache(evidence), replace(setup, t=setup.t * 1e-3), estimator, 0.05, 100)
    torch.testing.assert_close(one.error, other.error, rtol=1e-3, atol=1e-6)
    assert bool((one.core == other.core).all())


def test_errors_are_in_sizes_of_the_person_and_bounded():
    good = case(noise=0.0)
    evidence, setup = good.evidence, good.setup
    now = agreement(RayCache(evidence), setup, camera_check().thresholds.estimator, 0.05, 100)
    assert float(now.error.max()) < 1e-4
    rays = RayCache(evidence).view(setup, 0)
    far = errors(rays, setup.R[0], setup.t[0], now.points[0] + 1e5, now.known[0])
    assert float(far[~far.isnan()].max()) <= 0.1
    assert float(median(torch.full((2, 3), torch.nan, dtype=torch.float64))) == pytest.approx(0.1)


def test_a_view_that_goes_wrong_is_seen_from_then_on():
    good = case()
    pixels = good.evidence.pixels.clone()
    half = pixels.shape[2] // 2
    pixels[1, :, half:] += 60.0
    moved = replace(good.evidence, pixels=pixels)
    estimator = camera_check().thresholds.estimator
    course = agreement(RayCache(moved), good.setup, estimator, 0.05, 100).course
    assert course.shape == (len(moved.frame), 4)
    assert float(course[half:, 1].min()) > 2 * float(course[:half].max())


def test_resection_gives_the_camera_back():
    good = case(noise=0.0)
    evidence, setup = good.evidence, good.setup
    now = agreement(RayCache(evidence), setup, camera_check().thresholds.estimator, 0.05, 100)
    R, t = resect(RayCache(evidence).view(setup, 2), now.points[2], now.known[2], 0.1, 0)
    torch.testing.assert_close(R, setup.R[2], rtol=0, atol=1e-4)
    torch.testing.assert_close(t, setup.t[2], rtol=0, atol=2.0)
    nothing = torch.zeros_like(now.known[2])
    assert resect(RayCache(evidence).view(setup, 2), now.points[2], nothing, 0.1, 0) is None


def test_an_exchange_is_its_own_inverse():
    setup = case().setup
    assert exchange_views(exchange_views(setup, 0, 2).setup, 2, 0).setup.source == setup.source
    assert exchange_views(setup, 0, 2).setup.source == (2, 1, 0, 3)


def test_a_shift_beyond_the_evidence_is_refused():
    good = case()
    evidence, setup = good.evidence, good.setup
    with pytest.raises(ValueError, match="beyond"):
        RayCache(evidence).view(setup.replace_camera(1, shift=3), 1)


def test_frames_that_are_left_out_are_gaps():
    pixels = np.random.default_rng(0).uniform(0, 100, (20, 2, 17, 2)).astype(np.float32)
    frame = np.delete(np.arange(21), 7)
    found = choose(("a", "b"), pixels, np.ones(pixels.shape[:-1], bool), frame, 100, 2, "")
    at = int(torch.nonzero(found.frame == 8))
    assert found.valid[0, :, at].any(-1).tolist() == [True, False, True, True, True]
    torch.testing.assert_close(found.pixels[1, 0, at], torch.from_numpy(pixels[6, 1]).double())


def test_a_person_of_no_human_size_is_said_without_inventing_a_unit():
    good = case()
    evidence, setup = good.evidence, good.setup
    result = camera_check()(evidence, replace(setup, t=3 * setup.t))
    assert [(finding.code, finding.mended) for finding in result.findings] == [("scale", False)]


def test_views_that_nothing_explains_are_said_to_be_off():
    good = case()
    evidence, setup = good.evidence, good.setup
    pixels = evidence.pixels.clone()
    pixels[3] += 300 * torch.randn(
        pixels[3].shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    found = camera_check()(replace(evidence, pixels=pixels, at_rate=None), setup).findings
    assert [(finding.code, finding.cameras, finding.mended) for finding in found] == [
        ("off", (evidence.names[3],), False)
    ]


def test_a_repair_that_leaves_a_view_worse_than_the_others_is_said_and_not_made():
    spoilt = BREAKAGES["moved"].spoil(case())
    generator = torch.Generator().manual_seed(1)
    pixels = spoilt.evidence.pixels.clone()
    pixels[-1] += 20 * torch.randn(pixels[-1].shape, dtype=pixels.dtype, generator=generator)
    noisy = replace(spoilt, evidence=replace(spoilt.evidence, pixels=pixels))
    result = check(BREAKAGES["rotation_transposed"].spoil(noisy))
    found = {finding.code: finding for finding in result.findings}
    assert found["rotation_transposed"].mended, "of all cameras, this one too"
    assert found["moved"].cameras == (spoilt.evidence.names[-1],)
    assert not found["moved"].mended
    torch.testing.assert_close(result.setup.R, spoilt.setup.R)
    torch.testing.assert_close(result.setup.t, spoilt.setup.t)


def test_steps_of_one_kind_are_one_finding():
    first = Finding("out_of_sync", Severity.ERROR, "3 late", ("a",), 3.0)
    first = replace(first, before_px=20.0, after_px=8.0, mended=True)
    second = replace(first, text="4 late", value=4.0, before_px=8.0, after_px=5.0)
    assert merge_steps([first, second]) == [replace(second, before_px=20.0)]


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"astray": 0.0}, "astray"),
        ({"frames": 0}, "frames"),
        ({"shift": -1}, "shift"),
    ],
)
def test_bad_settings_are_named(changed, key):
    with pytest.raises(GhptConfigError, match=key):
        replace(camera_check(), **changed)


@pytest.mark.skipif(not sizes.NIGHTLY, reason="test_commands_agree.py has this recording by day")
def test_a_real_camera_that_is_off(shared_data):
    """Pose2Sim's third camera is off, or its first."""
    folder, whole = shared_data / "pose2sim_single", camera_check(frames=64, shift=20)
    result = recording_check(whole, folder / "pose", folder / "Calib_qualisys.toml")
    assert [(finding.code, finding.cameras) for finding in result.findings] == [
        ("moved", ("cam03", "cam01"))
    ]
    assert result.findings[0].before_px > 35
    assert not result.findings[0].mended


def test_a_real_rig_that_is_good(shared_data):
    whole = camera_check(frames=64, shift=20)
    folder = shared_data / "caliscope"
    result = recording_check(whole, folder / "xy_HOLISTIC.csv", folder / "camera_array.toml")
    assert result.findings == ()


def recording_check(camera_check, points, cameras):
    """What the camera check says of real key points and cameras."""
    people, file = read_key_points(points), read_cameras(cameras)
    sequence = person_sequence(people, file, person=None, check_sizes=False)
    evidence = gather(sequence, camera_check.frames, camera_check.shift)
    return camera_check(evidence, setup_of(sequence.cameras))


def test_cameras_without_extrinsics_are_refused():
    rig, crowd = human36m_rig("S8"), people(frames=30)
    file = replace(rig, path="intrinsics", R=None, t=None)
    values = crowd.key_points.numpy()
    person = SinglePerson(
        "",
        rig.names,
        JOINTS,
        np.arange(30),
        values,
        np.ones(values.shape[:-1]),
        crowd.valid.numpy(),
        None,
    )
    with pytest.raises(GhptDataError, match="extrinsics"):
        gather(person_sequence(person.detections, file), 24, 5)
