"""Every export read back by a reader that is not ours; forward kinematics from the file agrees with ours."""

from __future__ import annotations

import contextlib
import csv
import json
import resource
import signal
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.motion.motions import BodyMotion
from devices.marker_files import read_markers
from gateway.agreement import tracks_of
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.recording import SkeletonArrays
from gateway.recording.arrays import MarkerArrays
from gateway.recording.exporters import c3d as c3d_format
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.recording.exporters.take import take_of

LARGEST_ANGLE = 1e-4  # rad
LARGEST_DISTANCE = 1e-4  # m
RATE_HZ = 100.0
FRAMES = 120


def motion() -> SkeletonArrays:
    """A walking person, as recorded: two frames missing, a silent hand."""
    suit = load_rig("suit_17")
    moving: BodyMotion = move(dress(suit), suit.skeleton.name, 3)
    times = np.arange(FRAMES) / RATE_HZ + 2.0
    kept = np.delete(np.arange(FRAMES), [40, 41])
    q_wb = moving.state(times).q_wb[kept].copy()
    skeleton = suit.skeleton
    p_w = np.full((len(kept), skeleton.n_segments, 3), np.nan)
    p_w[:, 0] = np.column_stack([times, 0.1 * np.sin(times), 0.9 + 0 * times])[kept]
    hand = skeleton.index("left_hand")
    q_wb[60:70, hand] = np.nan
    status = np.full(q_wb.shape[:2], Status.MEASURED.value, np.uint8)
    status[60:70, hand] = Status.MISSING.value
    rates = np.zeros((len(kept), skeleton.n_segments, 3))
    return SkeletonArrays(
        time_ns=(10**18 + np.round(times[kept] * 1e9)).astype(np.int64),
        sequence=kept.astype(np.int64),
        q_wb=q_wb,
        p_w=p_w,
        angular_rate=rates + 0.25,
        joint_acceleration=rates - 1.5,
        sigma=np.full(q_wb.shape[:2], 0.01),
        status=status,
        skeleton=skeleton,
    )


ARRAYS = motion()


def exported(name, tmp_path, axes=None, units_per_m=None):
    """(take, file) of a format."""
    kind = FORMATS[name]
    take = take_of(ARRAYS, "walk", axes or kind.axes)
    path = tmp_path / f"walk{kind.suffix}"
    kind.write(take, path, units_per_m or kind.units_per_m)
    return take, path


def turned(take, frame, segment):
    return Rotation.from_quat(take.q_wb[frame, segment], scalar_first=True)


def test_holes_are_filled_and_told():
    take = take_of(ARRAYS, "walk", Axes.Z_UP)
    hand = take.skeleton.index("left_hand")
    assert len(take.q_wb) == FRAMES
    assert not np.isnan(take.q_wb).any()
    assert take.filled[:, 0].sum() == 2
    assert take.filled[:, hand].sum() == 12
    steps = [(turned(take, k, hand).inv() * turned(take, k + 1, hand)).magnitude() for k in range(FRAMES - 1)]
    assert max(steps) < 0.2
    np.testing.assert_allclose(take.q_wb[:40], ARRAYS.q_wb[:40], atol=1e-12)


def test_both_world_axes_are_the_same_motion():
    up, east = take_of(ARRAYS, "walk", Axes.Y_UP), take_of(ARRAYS, "walk", Axes.Z_UP)
    np.testing.assert_allclose(up.p_w[..., 1], east.p_w[..., 2], atol=1e-12)
    np.testing.assert_allclose(up.p_w[..., 2], -east.p_w[..., 1], atol=1e-12)
    np.testing.assert_allclose(up.tips_w[..., 0], east.tips_w[..., 0], atol=1e-12)


def never_known(segment):
    q_wb = ARRAYS.q_wb.copy()
    q_wb[:, segment] = np.nan
    return SkeletonArrays(**{**vars(ARRAYS), "q_wb": q_wb})


def test_a_segment_that_was_never_known_stays_with_its_parent_and_that_is_told():
    take = take_of(never_known(3), "walk", Axes.Z_UP)
    parent = int(ARRAYS.skeleton.parents[3])
    np.testing.assert_allclose(take.q_wb[:, 3], take.q_wb[:, parent], atol=1e-12)
    assert take.filled[:, 3].all()
    assert not take.filled[:, parent].all()


def test_a_root_that_was_never_known_is_refused():
    with pytest.raises(GatewayError, match=f"{ARRAYS.segment_names[0]} never had an orientation"):
        take_of(never_known(0), "walk", Axes.Z_UP)


def at_other_times(changed):
    time_ns = ARRAYS.time_ns.copy()
    changed(time_ns)
    return replace(ARRAYS, time_ns=time_ns)


def turn_back(time_ns):
    time_ns[50:] -= 30_000_000


def stand_still(time_ns):
    time_ns[:] = time_ns[0]


def pause(time_ns):
    time_ns[50:] += 86_400 * 10**9


def test_instants_that_are_not_later_than_those_before_are_left_out():
    """The answer was an error of the interpolation."""
    take = take_of(at_other_times(turn_back), "walk", Axes.Z_UP)
    assert len(take.q_wb) == FRAMES - 3
    assert (np.diff(take.recorded.time_ns) > 0).all()
    assert len(take.recorded.time_ns) == len(take.recorded.q_wb) == len(ARRAYS.time_ns) - 3


@pytest.mark.parametrize(
    ("changed", "told"),
    [(stand_still, "has 1 frame"), (pause, r"118 of 8640120 frames were recorded, .* for 86400 s")],
)
def test_times_of_which_no_motion_can_be_made_are_refused(changed, told):
    """A pause of days took all memory there was."""
    with pytest.raises(GatewayError, match=told):
        take_of(at_other_times(changed), "walk", Axes.Z_UP)
    with pytest.raises(GatewayError, match="walk"):
        tracks_of(at_other_times(changed), 0, "walk")


def test_bvh_read_by_bvhio(tmp_path):
    bvhio = pytest.importorskip("bvhio", reason="bvhio is not installed")
    take, path = exported("bvh", tmp_path)
    assert float(path.read_text().split("Frame Time:")[1].split()[0]) == pytest.approx(1 / RATE_HZ)
    root = bvhio.readAsBvh(str(path)).Root

    def check(joint, frame, turn_of_parent, place_of_parent):
        key, s = joint.Keyframes[frame], take.skeleton.index(joint.Name)
        offset = key.Position if joint is root else joint.Offset
        place = place_of_parent + turn_of_parent.apply(np.array(offset) / 100.0)
        q = key.Rotation
        turn = turn_of_parent * Rotation.from_quat([q.w, q.x, q.y, q.z], scalar_first=True)
        assert np.linalg.norm(place - take.p_w[frame, s]) < LARGEST_DISTANCE
        assert (turn.inv() * turned(take, frame, s)).magnitude() < LARGEST_ANGLE
        return 1 + sum(check(child, frame, turn, place) for child in joint.Children)

    for frame in (0, 41, FRAMES - 1):
        assert check(root, frame, Rotation.identity(), np.zeros(3)) == take.skeleton.n_segments


def test_c3d_points_read_by_another_library(tmp_path):
    pytest.importorskip("ezc3d", reason="the extra 'export' is not installed")
    c3d = pytest.importorskip("c3d", reason="c3d is not installed")
    take, path = exported("c3d", tmp_path)
    with path.open("rb") as handle:
        reader = c3d.Reader(handle)
        assert reader.point_rate == pytest.approx(RATE_HZ)
        labels = [label.strip() for label in reader.point_labels]
        points = np.array([frame[:, :3] for _, frame, _ in reader.read_frames()])
    n = take.skeleton.n_segments
    assert tuple(labels[:n]) == take.skeleton.segment_names
    np.testing.assert_allclose(points[:, :n] / 1000.0, take.p_w, atol=LARGEST_DISTANCE)
    np.testing.assert_allclose(points[:, n : 2 * n] / 1000.0, take.tips_w, atol=LARGEST_DISTANCE)
    knee = labels.index("left_knee_angles")
    j = [joint.name for joint in take.skeleton.joints].index("left_knee")
    np.testing.assert_allclose(points[:, knee], np.degrees(take.joint_angles[:, j]), atol=1e-3)


def test_c3d_rotations(tmp_path):
    ezc3d = pytest.importorskip("ezc3d", reason="the extra 'export' is not installed")
    take, path = exported("c3d", tmp_path)
    read = ezc3d.c3d(str(path))
    matrices = read["data"]["rotations"].transpose(3, 2, 0, 1)[..., :3, :3]
    expected = Rotation.from_quat(take.q_wb.reshape(-1, 4), scalar_first=True)
    errors = (Rotation.from_matrix(matrices.reshape(-1, 3, 3)).inv() * expected).magnitude()
    assert errors.max() < LARGEST_ANGLE
    assert read["parameters"]["ANALOG"]["RATE"]["value"][0] == pytest.approx(RATE_HZ)


def opensim_table(path):
    """(labels, rows) of a .sto or .mot file."""
    lines = path.read_text().splitlines()
    begin = lines.index("endheader") + 1
    return lines[:begin], lines[begin].split("\t"), [line.split("\t") for line in lines[begin + 1 :]]


def test_sto_orientations(tmp_path):
    take, path = exported("sto", tmp_path)
    head, labels, rows = opensim_table(path)
    assert "DataType=Quaternion" in head
    assert labels[1:] == [f"{name}_imu" for name in take.skeleton.segment_names]
    q = np.array([[list(map(float, cell.split(","))) for cell in row[1:]] for row in rows])
    np.testing.assert_allclose(q, take.q_wb, atol=1e-8)
    np.testing.assert_allclose([float(row[0]) for row in rows], take.time_s, atol=1e-6)


def test_mot_angles_have_the_model_s_names_and_signs(tmp_path):
    take, path = exported("mot", tmp_path)
    head, labels, rows = opensim_table(path)
    assert "inDegrees=yes" in head
    assert f"nColumns={len(labels)}" in head
    values = np.array(rows, float)
    for label, joint, angle, sign in (
        ("knee_angle_l", "left_knee", "flexion", 1.0),
        ("hip_adduction_r", "right_hip", "adduction", 1.0),
        ("lumbar_extension", "spine", "flexion", -1.0),
    ):
        j, a = next((j, a) for j, a, name in take.angle_names if name == f"{joint}_{angle}")
        expected = sign * np.degrees(take.joint_angles[:, j, a])
        np.testing.assert_allclose(values[:, labels.index(label)], expected, atol=1e-6)


def test_trc_markers(tmp_path):
    take, path = exported("trc", tmp_path)
    lines = path.read_text().splitlines()
    values = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (float(values["DataRate"]), values["Units"]) == (RATE_HZ, "mm")
    names = [name for name in lines[3].split("\t")[2:] if name]
    table = np.array([line.split("\t") for line in lines[6:]], float)
    points = table[:, 2:].reshape(len(table), -1, 3) / 1000.0
    np.testing.assert_allclose(
        points[:, names.index("head")], take.p_w[:, take.skeleton.index("head")], atol=1e-6
    )
    tip = names.index("right_foot_tip")
    np.testing.assert_allclose(points[:, tip], take.tips_w[:, take.skeleton.index("right_foot")], atol=1e-6)


def test_csv_and_parquet_are_the_same_table(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'export' is not installed")
    take, path = exported("csv", tmp_path)
    _, other = exported("parquet", tmp_path)
    table = parquet.read_table(other)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == table.column_names
    for name in ("pelvis_orientation_w", "head_position_z_m", "left_knee_flexion_deg", "pelvis_sigma_rad"):
        from_csv = np.array([float(row[name] or "nan") for row in rows])
        np.testing.assert_allclose(from_csv, table[name].to_numpy(), rtol=1e-8)
    assert rows[40]["pelvis_status"] == "not_recorded"
    assert rows[40]["pelvis_angular_rate_x_rad_per_s"] == ""
    assert rows[62]["left_hand_status"] == "missing"
    assert len(rows) == len(take.q_wb)


def glb_parts(path):
    """(JSON, binary) of a .glb by its specification."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    json_length, json_kind = struct.unpack_from("<I4s", data, 12)
    assert json_kind == b"JSON"
    binary_at = 20 + json_length
    assert data[binary_at + 4 : binary_at + 8] == b"BIN\0"
    return json.loads(data[20:binary_at]), data[binary_at + 8 :]


def test_gltf_animation_by_its_specification(tmp_path):
    pytest.importorskip("pygltflib", reason="the extra 'export' is not installed")
    take, path = exported("gltf", tmp_path)
    document, binary = glb_parts(path)
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def values(accessor):
        each = document["accessors"][accessor]
        view = document["bufferViews"][each["bufferView"]]
        begin, width = view.get("byteOffset", 0), widths[each["type"]]
        flat = np.frombuffer(binary, "<f4", each["count"] * width, begin)
        return flat.reshape(-1, width)

    animation, nodes = document["animations"][0], document["nodes"]
    tracks = {
        (channel["target"]["node"], channel["target"]["path"]): animation["samplers"][channel["sampler"]]
        for channel in animation["channels"]
    }
    root = document["skins"][0]["skeleton"]
    np.testing.assert_allclose(values(tracks[root, "rotation"]["input"])[:, 0], take.time_s, atol=1e-5)
    frame = 70

    def check(node, turn_of_parent, place_of_parent):
        offset = np.array(nodes[node]["translation"])
        if (node, "translation") in tracks:
            offset = values(tracks[node, "translation"]["output"])[frame]
        place = place_of_parent + turn_of_parent.apply(offset)
        turn = turn_of_parent * Rotation.from_quat(values(tracks[node, "rotation"]["output"])[frame])
        s = take.skeleton.index(nodes[node]["name"])
        assert np.linalg.norm(place - take.p_w[frame, s]) < LARGEST_DISTANCE
        assert (turn.inv() * turned(take, frame, s)).magnitude() < LARGEST_ANGLE
        return 1 + sum(check(child, turn, place) for child in nodes[node].get("children", ()))

    assert check(root, Rotation.identity(), np.zeros(3)) == take.skeleton.n_segments


@pytest.mark.parametrize(("name", "units_per_m"), [("bvh", 1.0), ("trc", 100.0), ("csv", 1000.0)])
def test_units_are_kept_to(tmp_path, name, units_per_m):
    take, path = exported(name, tmp_path, units_per_m=units_per_m)
    text = path.read_text()
    if name == "csv":
        assert "pelvis_position_x_mm" in text.splitlines()[0]
    elif name == "trc":
        assert text.splitlines()[2].split("\t")[4] == "cm"
    else:
        first = text.split("Frame Time:")[1].splitlines()[1].split()
        np.testing.assert_allclose(np.array(first[:3], float), take.p_w[0, 0], atol=1e-6)


def with_markers() -> SkeletonArrays:
    """The same motion, made from three markers of which one was not seen, and one left out, for a while."""
    n = len(ARRAYS.time_ns)
    expected = np.random.default_rng(4).normal(0.0, 1.0, (n, 3, 3))
    positions = expected + np.array([0.003, 0.0, 0.004])
    positions[10:20, 1] = np.nan
    used = np.isfinite(positions).all(axis=2)
    used[30:35, 2] = False
    nameless = (np.zeros((0, 3)),) * n
    return replace(
        ARRAYS, markers=MarkerArrays(("LASI", "RASI", "SACR"), positions, expected, used, nameless)
    )


@pytest.mark.parametrize("axes", list(Axes))
def test_markers_go_along_in_tables_with_what_became_of_them(tmp_path, axes):
    arrays = with_markers()
    path = tmp_path / "walk.csv"
    FORMATS["csv"].write(take_of(arrays, "walk", axes), path, 1000.0)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    seen = np.array([float(row["marker_SACR_x_mm"] or "nan") for row in rows])
    assert np.flatnonzero(np.isnan(seen)).tolist() == [40, 41]  # not recorded
    kept = np.delete(np.arange(FRAMES), [40, 41])
    up = "z" if axes is Axes.Z_UP else "y"
    heights = [float(rows[k][f"marker_LASI_{up}_mm"]) for k in kept]
    np.testing.assert_allclose(heights, 1e3 * arrays.markers.positions[:, 0, 2], atol=1e-3)
    assert float(rows[5]["marker_LASI_residual_mm"]) == pytest.approx(5.0)
    assert (rows[12]["marker_RASI_x_mm"], rows[12]["marker_RASI_used"]) == ("", "False")
    assert [k for k in kept if rows[k]["marker_SACR_used"] == "False"] == list(range(30, 35))


@pytest.mark.parametrize("name", ["bvh", "c3d", "csv", "mot", "osim", "sto", "trc"])
def test_names_in_any_letters_are_written(name, tmp_path):
    """Headers hold the file's name, and markers may be called anything: both ended with a traceback."""
    arrays, kind = with_markers(), FORMATS[name]
    markers = replace(arrays.markers, labels=("Schädel", "RASI", "SACR"))
    path = tmp_path / f"Übung ☃{kind.suffix}"
    kind.write(take_of(replace(arrays, markers=markers), path.stem, kind.axes), path, kind.units_per_m)
    if name == "trc":
        assert "Schädel" in read_markers(path).labels
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_markers_go_along_in_trc_and_c3d(tmp_path):
    ezc3d = pytest.importorskip("ezc3d", reason="the extra 'export' is not installed")
    arrays = with_markers()
    for name in ("trc", "c3d"):
        path = tmp_path / f"walk{FORMATS[name].suffix}"
        FORMATS[name].write(take_of(arrays, "walk", Axes.Z_UP), path, 1000.0)
        trial = read_markers(path)
        read = trial.columns(("LASI", "RASI", "SACR"))
        kept = np.delete(np.arange(FRAMES), [40, 41])
        np.testing.assert_allclose(read[kept], arrays.markers.positions, atol=1e-6)
        assert np.isnan(read[40:42]).all()
    found = ezc3d.c3d(str(tmp_path / "walk.c3d"))
    column = found["parameters"]["POINT"]["LABELS"]["value"].index("LASI")
    assert found["data"]["meta_points"]["residuals"][0, column, 5] == pytest.approx(5.0, abs=0.05)


def test_a_c3d_is_the_same_written_in_pieces(tmp_path, monkeypatch):
    _, path = exported("c3d", tmp_path)
    whole = path.read_bytes()
    monkeypatch.setattr(c3d_format, "_FRAMES_AT_ONCE", 7)
    exported("c3d", tmp_path)
    assert path.read_bytes() == whole


def test_a_c3d_leaves_out_rotations_whose_place_it_cannot_tell(tmp_path, monkeypatch):
    ezc3d = pytest.importorskip("ezc3d")
    monkeypatch.setattr(c3d_format, "_LAST_BLOCK", 100)
    take, path = take_of(ARRAYS, "walk", Axes.Z_UP), tmp_path / "walk.c3d"
    assert "no rotations" in FORMATS["c3d"].write(take, path, 1000.0)
    read = ezc3d.c3d(str(path))
    assert "ROTATION" not in read["parameters"]
    np.testing.assert_allclose(read["data"]["points"][:3, 0].T, 1000 * take.p_w[:, 0], rtol=1e-6)


def test_a_c3d_has_more_labels_than_one_list_holds(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    labels = tuple(f"M{n}" for n in range(300))
    arrays = with_markers()
    markers = replace(
        arrays.markers,
        labels=labels,
        positions=np.tile(arrays.markers.positions[:, :1], (1, 300, 1)),
        virtual=np.tile(arrays.markers.virtual[:, :1], (1, 300, 1)),
        used=np.tile(arrays.markers.used[:, :1], (1, 300)),
    )
    path = tmp_path / "walk.c3d"
    FORMATS["c3d"].write(take_of(replace(arrays, markers=markers), "walk", Axes.Z_UP), path, 1000.0)
    assert read_markers(path).labels[-300:] == labels
    assert ezc3d.c3d(str(path))["data"]["points"].shape[1] == len(read_markers(path).labels)


def test_a_take_made_from_a_file_keeps_the_files_own_time(tmp_path):
    """Forces of the same trial, and other people of the same film, then line up."""
    late = replace(ARRAYS, origin_ns=int(ARRAYS.time_ns[0]) - 400_000_000)
    for name in ("trc", "mot", "csv", "c3d"):
        kind = FORMATS[name]
        take = take_of(late, "walk", kind.axes)
        assert take.time_s[0] == pytest.approx(0.4)
        kind.write(take, tmp_path / f"walk{kind.suffix}", kind.units_per_m)
    for name in ("trc", "c3d"):
        trial = read_markers(tmp_path / f"walk.{name}")
        assert trial.begins_s == pytest.approx(0.4)
        assert trial.rate_hz == RATE_HZ
    rows = (tmp_path / "walk.mot").read_text().splitlines()
    assert float(rows[rows.index("endheader") + 2].split("\t")[0]) == pytest.approx(0.4)
    first = next(csv.DictReader((tmp_path / "walk.csv").open()))
    assert float(first["time_s"]) == pytest.approx(0.4)
    assert int(first["gateway_time_ns"]) == ARRAYS.time_ns[0]


@pytest.mark.parametrize("begins_s", [-3.0, 655.3, 50_000.0])
def test_a_take_keeps_its_time_beyond_what_headers_count(tmp_path, begins_s):
    """A C3D's header numbers frames by 16 bits, and no frame is before the first."""
    late = replace(ARRAYS, origin_ns=int(ARRAYS.time_ns[0]) - round(begins_s * 1e9))
    for name in ("trc", "c3d") if begins_s > 0 else ("trc",):
        kind = FORMATS[name]
        kind.write(take_of(late, "walk", kind.axes), tmp_path / f"walk{kind.suffix}", kind.units_per_m)
        trial = read_markers(tmp_path / f"walk{kind.suffix}")
        assert trial.begins_s == pytest.approx(begins_s)
        assert trial.n_frames == FRAMES


@pytest.mark.parametrize("rate_hz", [120.0, 60.0, 59.94, 29.97003, 300.0, 1000.0 / 3.0])
def test_the_rate_of_whole_nanoseconds_is_exact(rate_hz):
    time_ns = np.round(np.arange(50) * 1e9 / rate_hz).astype(np.int64)
    found = replace(ARRAYS, time_ns=time_ns).rate_hz
    assert found == pytest.approx(rate_hz, rel=3e-7)
    if rate_hz == round(rate_hz, 5):
        assert found == rate_hz


@contextlib.contextmanager
def largest_file(size: int):
    """Writing beyond so many bytes fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_file_that_cannot_be_written_whole_is_not_there(tmp_path, name):
    if FORMATS[name].package:
        pytest.importorskip(FORMATS[name].package, reason="the extra 'export' is not installed")
    _, path = exported(name, tmp_path)
    whole = path.read_bytes()
    path.unlink()
    with largest_file(len(whole) // 2), pytest.raises(GatewayError, match=f"{path.name} cannot be written"):
        exported(name, tmp_path)
    assert list(tmp_path.iterdir()) == []
