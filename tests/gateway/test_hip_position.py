"""Cameras as the position device of somebody with modules: simulated cameras, and modules at rest."""

import numpy as np
import pytest
import yaml

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps
from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.body.subject_file import write_subject
from gateway.contract.balances import unaccounted
from gateway.emulation.video_truth import messages_of, ring_of_cameras, walking
from gateway.errors import SettingsError
from gateway.frames import InertialBatch, Quantity
from gateway.pipeline import Pipeline
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.recording.snapshot import decode_suit, encode_suit
from gateway.recording.video import video_subject, video_suit
from gateway.service.accounting import balances_of
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.typed_here import typed_here

CAMERAS = ring_of_cameras(3)
N, TURN, LATENCY_MS = 8, 90.0, 40
CAMERA_ENTRY = {"subject": "anna.yaml", "device": 60, "turn_deg": TURN, "latency_ms": LATENCY_MS}
DEVICE = {"kind": "position", "device": 60, "segment": "pelvis"}


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Folder with the rig, messages by instant, and the true middle of the hips, (N, 3) m."""
    keypoints = load_keypoint_set("blazepose_33")
    person = walking(keypoints, N, (-0.2, 0.1), (1.0, 0.2))
    instants = messages_of(CAMERAS, keypoints, person)
    hips = [person.markers.labels.index(label) for label in ("left_hip", "right_hip")]
    folder = tmp_path_factory.mktemp("rig")
    write_subject(folder / "anna.yaml", video_subject("anna", video_suit(CAMERAS, "full", instants)))
    write_rig(folder)
    return folder, instants, person.keypoints[:, hips].mean(axis=1)


def write_rig(folder, cameras=CAMERA_ENTRY, devices=(DEVICE,)):
    modules = [{"id": 1, "segment": "pelvis", "sensor_to_segment": [1, 0, 0, 0]}]
    rig = {"body": "human_17", "modules": modules, "local_devices": list(devices), "cameras": cameras}
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    return str(folder / "rig.yaml")


def fed(suit, instants, reconstructor="independent"):
    """A pipeline that has seen the cameras and a module at rest; the frames of it."""
    settings = GatewaySettings(
        links=[LinkSettings(name="cameras", url="mqtt:///a/+", carries="heat_maps")],
        rig="rig.yaml",
        reconstructor=reconstructor,
    )
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link("cameras", "heat_maps")
    observed = []
    arrivals = [10**9 + round(t * 1e9 / 60) for t in range(N)]
    for t, instant in enumerate(instants):
        assert pipeline.feed(Chunk(b"".join(instant), arrivals[t], "cameras")) == []
    for k in range(60):
        time_ns = 10**9 - 10**8 + k * 10**7
        measured = (0.0, 0.0, 9.81), (0.0, 0.0, 0.0), (0.0, 20.0, -40.0)
        batch = InertialBatch.of([(1, k, time_ns, measured, 0)])
        observed += pipeline.module_stage.assembler.add(batch.samples, time_ns)
    return pipeline, observed, arrivals


def test_the_hips_that_cameras_see_are_readings_of_the_device(seen):
    folder, instants, truth = seen
    suit = load_rig(str(folder / "rig.yaml"))
    _, observed, arrivals = fed(suit, instants)
    readings = [reading for frame in observed for reading in frame.local]
    assert len(readings) == N
    assert {(r.device, r.quantity) for r in readings} == {(60, Quantity.POSITION)}
    turned = np.stack([-truth[:, 1], truth[:, 0], truth[:, 2]], axis=1)  # a quarter turn: north is their X
    off = np.linalg.norm([r.value for r in readings] - turned, axis=1)
    assert np.median(off) < 0.02
    np.testing.assert_allclose([r.sigma for r in readings], 0.02)
    late = np.subtract(arrivals, [r.time_ns for r in readings])
    np.testing.assert_allclose(late, LATENCY_MS * 1e6, atol=2e3)


@pytest.mark.parametrize("reconstructor", ["articulated", "joint"])
def test_the_root_is_where_the_cameras_see_the_hips(seen, reconstructor):
    folder, instants, truth = seen
    suit = load_rig(str(folder / "rig.yaml"))
    pipeline, observed, _ = fed(suit, instants, reconstructor)
    placed = [pipeline.module_stage.reconstructor.update(frame) for frame in observed]
    pelvis = suit.skeleton.index("pelvis")
    last = max(k for k, frame in enumerate(observed) if frame.local)
    assert np.linalg.norm(placed[last].p_w[pelvis] - [-truth[-1, 1], truth[-1, 0], truth[-1, 2]]) < 0.05


def test_the_same_from_a_recorded_suit_bit_for_bit(seen):
    folder, instants, _ = seen
    suit = load_rig(str(folder / "rig.yaml"))
    first, again = fed(suit, instants)[1], fed(decode_suit(encode_suit(suit)), instants)[1]
    values = [[r.value.tolist() for frame in frames for r in frame.local] for frames in (first, again)]
    assert values[0] == values[1]


def test_readings_of_cameras_are_accounted_for(seen):
    folder, instants, _ = seen
    pipeline = Pipeline.from_settings(
        GatewaySettings(
            links=[LinkSettings(name="cameras", url="mqtt:///a", carries="heat_maps")],
            rig="rig.yaml",
            reconstructor="independent",
        ),
        load_rig(str(folder / "rig.yaml")),
    )
    pipeline.add_link("cameras", "heat_maps")
    for t, instant in enumerate(instants):
        pipeline.feed(Chunk(b"".join(instant), t, "cameras"))
    readings = next(each for each in pipeline.balances() if each.name == "readings")
    assert (readings.total, readings.parts["taken"]) == (N, N)
    assert unaccounted(balances_of(pipeline)) == {}


def test_a_hip_that_nobody_sees_gives_no_reading(seen):
    folder, instants, _ = seen
    nobody = [
        encode_heat_maps(HeatMapMessage(c.name, "full", N - 1, 0, None, np.zeros((2, 3)))) for c in CAMERAS
    ]
    _, observed, _ = fed(load_rig(str(folder / "rig.yaml")), [*instants[:-1], nobody])
    assert len([reading for frame in observed for reading in frame.local]) == N - 1


@pytest.mark.parametrize(
    ("rig", "carries", "told"),
    [
        ("anna.yaml", "heat_maps", "3 cameras on body"),
        ("rig.yaml", "heat_maps", "1 modules, 3 cameras on body"),
    ],
)
def test_checked_settings_name_the_cameras(seen, rig, carries, told):
    folder, *_ = seen
    path = folder / "gateway.yaml"
    link = {"name": "cameras", "url": "mqtt:///a/+", "carries": carries}
    path.write_text(yaml.safe_dump({"rig": rig, "links": [link]}))
    code, output, errors = typed_here(["config", "check", path])
    assert (code, errors) == (0, "")
    assert told in output


def test_cameras_without_a_device_or_a_subject_without_cameras_are_refused(seen, tmp_path):
    folder, *_ = seen
    (tmp_path / "anna.yaml").write_text((folder / "anna.yaml").read_text())
    with pytest.raises(SettingsError, match="no local device of kind 'position' has the id 60"):
        load_rig(write_rig(tmp_path, devices=[]))
    with pytest.raises(SettingsError, match="'suit_17' names no cameras: one that does is written"):
        load_rig(write_rig(tmp_path, CAMERA_ENTRY | {"subject": "suit_17"}))
