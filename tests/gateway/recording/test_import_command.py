"""Imports end to end: real files to recordings that replay bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.vendor_formats.sheets import FormatError
from gateway.body.joint_angles import joint_angles
from gateway.errors import GatewayError
from gateway.imports.formats import ReadOptions, detected, read
from gateway.imports.segment_names import mapped_segments, segment_of
from gateway.recording import open_recording
from gateway.recording.difference import difference
from gateway.recording.solving import verify


def joint(path, name):
    """Time (F,) and angles (F, 3) of a joint, degrees."""
    poses = open_recording(path).skeleton_arrays()
    index = [each.name for each in poses.skeleton.joints].index(name)
    return poses.time_s, np.degrees(joint_angles(poses.skeleton, poses.q_wb)[:, index])


def test_opensense_gait_walks_with_its_knees(recording_set, typed, tmp_path):
    """From OpenSense's own example: mapping file, standing at first, pelvis z forward."""
    data, target = recording_set("opensense_gait8"), tmp_path / "gait.mcap"
    code, told = typed("import", data / "IMUData", "--map", data / "myIMUMappings.xml",
                       "--neutral", "0:1", "--forward", "z", "-o", target, "--json")  # fmt: skip
    assert code == 0
    assert (told["format"], told["modules"], told["reconstructor"]) == ("xsens", 8, "fused")
    assert told["segments"]["00B4227D"] == "right_shank"
    assert verify(open_recording(target)).is_identical
    for side in ("left", "right"):
        time_s, knee = joint(target, f"{side}_knee")
        assert np.abs(knee[time_s < 1]).max() < 3, "the neutral posture"
        walking = knee[(time_s > 12) & (time_s < 22)]
        assert 45 < walking[:, 0].max() < 80, "flexion in swing"
        assert walking[:, 0].min() > -15, "no knee bends backwards"
        assert np.abs(walking[:, 1]).max() < 25, "little adduction"


def test_ximu3_keeps_the_losses_that_its_stamps_show(recording_set, typed, tmp_path):
    target = tmp_path / "xio.mcap"
    _, told = typed("import", recording_set("xio_lower_body7"), "-o", target, "--json")
    assert told["segments"]["Right Upper Leg"] == "right_thigh"
    recording = open_recording(target)
    assert verify(recording).is_identical
    modules = list(recording.statistics())[-1].values["modules"]
    lost = {label: modules[str(i)]["lost"] / 2 for i, label in enumerate(told["segments"])}  # raw and fused
    assert lost == {"pelvis": 28, "Right Upper Leg": 27, "Right Lower Leg": 11, "Right Foot": 23,
                    "Left Upper Leg": 8, "Left Lower Leg": 21, "Left Foot": 8}  # fmt: skip


def test_our_filter_and_theirs_on_one_body_agree(recording_set, typed, tmp_path):
    """Seventeen modules, raw and fused in one file: seven seconds of them solved by either method."""
    folder = tmp_path / "measured"
    folder.mkdir()
    for path in recording_set("hipose_mtw17").glob("*.csv"):
        lines = path.read_text().splitlines(keepends=True)
        (folder / path.name).write_text("".join(lines[:700]))
    maps = {"23": "right_hand", "24": "right_foot", "25": "left_shoulder", "26": "left_upper_arm",
            "27": "left_forearm", "28": "left_hand", "29": "head", "2a": "sternum", "2b": "right_thigh",
            "2c": "left_thigh", "2d": "pelvis", "2e": "right_shank", "2f": "right_shoulder",
            "30": "right_forearm", "31": "left_foot", "33": "left_shank",
            "34": "right_upper_arm"}  # fmt: skip
    mapping = tmp_path / "map.yaml"
    mapping.write_text("".join(f"00b45c{key}: {value}\n" for key, value in maps.items()))
    ours, theirs = tmp_path / "ours.mcap", tmp_path / "theirs.mcap"
    arguments = ("import", folder, "--map", mapping, "--neutral", "0.5:3", "--json")
    assert typed(*arguments, "-o", ours)[1]["reconstructor"] == "independent"
    assert typed(*arguments, "-o", theirs, "--reconstructor", "fused")[1]["modules"] == 17
    for path in (ours, theirs):
        assert verify(open_recording(path)).is_identical
    found = difference(open_recording(ours).skeleton_arrays(), open_recording(theirs).skeleton_arrays())
    tilts = [segment.inclination_rms_deg for segment in found.segments]
    assert len(tilts) == 17
    assert np.median(tilts) < 3.0


@pytest.mark.parametrize(
    ("name", "files", "modules"),
    [("movella_dot_pairs", "knee_tracking1", 2), ("skinematics_formats", "walking_xsens_*.txt", 2)],
)
def test_pairs_at_a_knee(recording_set, typed, tmp_path, name, files, modules):
    target = tmp_path / "knee.mcap"
    _, told = typed("import", *sorted(recording_set(name).glob(files)), "-o", target, "--json")
    assert (told["modules"], sorted(told["segments"].values())) == (modules, ["right_shank", "right_thigh"])
    assert len([note for note in told["notes"] if "tells no side" in note]) == 2
    assert verify(open_recording(target)).is_identical
    assert open_recording(target).meta.skeleton.segment_names == ("right_thigh", "right_shank")


def test_mvnx_keeps_its_segments_and_its_axes(typed, tmp_path):
    """A knee bent by 40°, in MVN's axes, is a knee bent by 40° in ours."""
    shank = Rotation.from_euler("y", 40, degrees=True).as_quat(scalar_first=True)
    frame = "1 0 0 0  1 0 0 0 " + " ".join(f"{x:.7f}" for x in shank)
    frames = "".join(
        f'<frame index="{n}" type="normal"><orientation>{frame}</orientation></frame>' for n in range(9)
    )
    names = "".join(f'<segment label="{name}"/>' for name in ("Pelvis", "RightUpperLeg", "RightLowerLeg"))
    path, target = tmp_path / "a.mvnx", tmp_path / "a.mcap"
    path.write_text(f'<mvnx><subject frameRate="60"><segments>{names}</segments>{frames}</subject></mvnx>')
    typed("import", path, "-o", target, "--json")
    _, knee = joint(target, "right_knee")
    np.testing.assert_allclose(knee, np.tile([40, 0, 0], (len(knee), 1)), atol=0.02)


@pytest.mark.parametrize("text", ["PathFileType\t4\n", "Format Version,1.23\n", "NO_OF_FRAMES\t3\n"])
def test_markers_are_sent_to_where_they_are_read(typed, tmp_path, text):
    path = tmp_path / "walk.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match="holds markers: `mocap-gateway optical fit`"):
        typed("import", path)


def test_nothing_that_is_no_recording_is_taken_for_one(typed, tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"\x00\x01" * 20)
    with pytest.raises(FormatError, match=r"no format that is known.*name one with --format"):
        typed("import", path)
    with pytest.raises(FormatError, match="cannot be read: No such file"):
        typed("import", tmp_path / "absent.txt")
    path.write_text("a,b,c\n1,2,3\n")
    with pytest.raises(GatewayError, match=r"--columns MAP\.yaml"):
        typed("import", path)


@pytest.mark.parametrize(("peak_rate", "is_left_out"), [(2.0, True), (0.0, False)])
def test_a_magnetometer_that_repeats_itself_in_motion_is_left_out_and_named(
    tmp_path, peak_rate: float, is_left_out: bool
):
    t = np.arange(0.0, 10.0, 0.01)
    rate = np.column_stack([peak_rate * np.sin(t), 0.1 * np.cos(t), 0.0 * t])
    force, field = np.tile([0.0, 0.0, 9.81], (len(t), 1)), np.tile([10.0, 20.0, 30.0], (len(t), 1))
    rows = np.column_stack([t, force, rate, field])
    np.savetxt(tmp_path / "arm.csv", rows, delimiter=",", header="t,ax,ay,az,gx,gy,gz,mx,my,mz", comments="")
    parts = (("specific_force", "a"), ("angular_rate", "g"), ("magnetic_field", "m"))
    lines = [f"    {part}: {{columns: [{axis}x, {axis}y, {axis}z]}}" for part, axis in parts]
    (tmp_path / "columns.yaml").write_text(
        "\n".join(["time: {column: t, unit: s}", "modules:", "  - name: right_forearm", *lines])
    )
    options = ReadOptions(columns=tmp_path / "columns.yaml")
    recording = read([tmp_path / "arm.csv"], "csv", options)
    (track,) = recording.modules
    assert np.isnan(track.magnetic_field).all() == is_left_out
    assert ("the magnetometer of right_forearm" in "".join(recording.notes)) == is_left_out


@pytest.mark.parametrize(
    ("name", "segment"),
    [
        ("Pelvis", "pelvis"), ("tibia_r", "right_shank"), ("RightUpperLeg", "right_thigh"),
        ("calcn_l_imu", "left_foot"), ("Left Lower Leg", "left_shank"), ("torso_imu", "thorax"),
        ("T8", "thorax"),
        ("LeftForeArm", "left_forearm"), ("right_shoulder", "right_shoulder_girdle"),
        ("humerus-r", "right_upper_arm"),
    ],
)  # fmt: skip
def test_names_mean_segments(name, segment):
    assert segment_of(name) == (segment, False)


def test_maps_that_cannot_be_are_refused():
    known = ("pelvis", "left_thigh", "right_thigh")
    with pytest.raises(GatewayError, match="no module is called 'thig'"):
        mapped_segments({0: "pelvis"}, {"thig": "pelvis"}, known)
    with pytest.raises(GatewayError, match="'a' is mapped to 'knee', which is no segment"):
        mapped_segments({0: "a"}, {"a": "knee"}, known)
    with pytest.raises(GatewayError, match="'thigh' and 'femur_r' both mean right_thigh"):
        mapped_segments({0: "thigh", 1: "femur_r"}, {}, known)
    assert mapped_segments({0: "sn-07", 1: "Pelvis", 2: "wrist"}, {"07": "left_thigh"}, known).unknown == (
        "wrist",
    )


def test_a_folder_without_files_of_modules_is_said_with_the_folders_in_it(tmp_path):
    """OpenSense's own example has the files one folder below a licence: an IndexError was the answer."""
    (tmp_path / "LICENSE.txt").write_text("as you like")
    (tmp_path / "IMUData").mkdir()
    options = ReadOptions()
    with pytest.raises(
        FormatError, match=r"no \.txt or \.csv file of modules in it.*folders in it \(IMUData\)"
    ):
        detected([tmp_path], options)
    with pytest.raises(FormatError, match="file of modules in it"):
        read([tmp_path], "xsens", options)


def test_a_picture_is_not_taken_for_markers(tmp_path):
    picture = tmp_path / "page.png"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    with pytest.raises(FormatError, match="has no format that is known"):
        detected([picture], ReadOptions())
