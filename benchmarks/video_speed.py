"""Suite ``video_speed``: four cameras to skeleton frames, by stage and by the clock; what heat maps cost."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import psutil

from benchmarks.figures import Figure, Report, table
from benchmarks.video_people import pasted
from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps, quantised
from devices.cameras.pictures import Picture, open_pictures
from devices.link import Chunk
from gateway.body.camera import Camera
from gateway.body.skeleton import VideoSetUp
from gateway.calibration.cameras_file import load_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.cameras.camera_process import CameraTask
from gateway.cameras.filmed_people import FilmedPeople
from gateway.cameras.live_crowd import AHEAD, CrowdInstant, LiveCrowd
from gateway.cameras.rig_of_cameras import CameraRig, RigOptions
from gateway.errors import GatewayError
from gateway.frames import FloatArray, HeatMapFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.low_pass import DELAY
from gateway.reconstruction.video.networks.cropping import cropped
from gateway.reconstruction.video.networks.network import PoseNetwork
from gateway.reconstruction.video.networks.person_detector import PersonDetector
from gateway.reconstruction.video.networks.weights import load_network
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.reconstruction.video.region import PersonRegion, peaks, region_of_maps
from gateway.recording.video import LINK, video_chunks, video_settings, video_suit
from gateway.sources.heat_maps import heat_map_frame
from gateway.stages.cameras import CameraStage

DATA = Path(__file__).parents[2] / "shared" / "data" / "pose2sim_single"
NETWORKS = ("lite", "full", "heavy")
_CORES = 2
_NETWORK_PICTURES = 12
_CROP = 256
_MIRRORED = 8
_FIRST, _TIMED = 26, 26
"""Instants: until the people have been measured, and then."""
INSTANTS = _FIRST + _TIMED + AHEAD
_CLOCK = "4 cameras of 1088×1920 on 2 cores, BlazePose full, from files to poses"

Value = TypeVar("Value")


class Stages:
    """Processor time by stage; the smallest tenth counts, since the machine is shared."""

    def __init__(self) -> None:
        self._spent: dict[str, list[float]] = defaultdict(list)

    def timed(self, stage: str, work: Callable[[], Value]) -> Value:
        """What ``work`` gives."""
        began = time.process_time()
        value = work()
        self._spent[stage].append(time.process_time() - began)
        return value

    def ms(self, stage: str) -> float:
        """Of one call; of decoding the mean, for a decoder works ahead and gives several pictures at once."""
        spent = self._spent[stage]
        return 1e3 * float(np.mean(spent) if stage == "decode" else np.percentile(spent, 10))


def run() -> Report:
    """Of the real walker. Raises ``GatewayError`` without weights."""
    report = Report("video_speed")
    cameras, places = _cameras()
    stages = Stages()
    messages = [_looked_at(camera, place, stages) for camera, place in zip(cameras, places, strict=True)]
    instants = [list(each) for each in zip(*messages, strict=True)]
    rate = open_pictures(places[0]).info.rate_hz
    solve_ms = _solve_ms(cameras, instants, rate)
    networks = {name: _network_ms(places[2], name) for name in NETWORKS}
    rest = sum(stages.ms(stage) for stage in ("decode", "crop", "follow", "message"))
    per_second = {
        name: _CORES * 1e3 / (len(cameras) * (rest + ms) + solve_ms) for name, ms in networks.items()
    }
    _add_tables(report, stages, networks, per_second, solve_ms)
    tasks = [CameraTask(camera.name, place, "full") for camera, place in zip(cameras, places, strict=True)]
    report.figures += _rates("one_person", _by_the_clock(cameras, tasks, 1), ">=15", "")
    with tempfile.TemporaryDirectory() as folder:
        both = pasted(tuple(cameras), _known(cameras, instants), Path(folder))
        os.sync()  # a gigabyte of pictures that is still being written would be measured, too
        report.figures += _rates(
            "two_people",
            _by_the_clock(cameras, both, 2),
            ">=10",
            "; the second is pasted in, pictures are .bmp",
        )
    size = float(np.mean([len(message) for each in messages for message in each]))
    report.figures += [
        Figure("message_bytes", size, "bytes", "", "heat maps of one picture as they go over the wire"),
        Figure(
            "delay_ms", 1e3 * DELAY / rate + rest + networks["full"] + solve_ms, "ms", "",
            f"smoothing ({DELAY} pictures at {rate:g} Hz) and one picture's way through all stages",
        ),
        Figure(
            "mirrored_peaks_cells", _mirrored_offset(places[2]), "cells", "<=0.1",
            "by which peaks in mirrored pictures are not the mirrored peaks: half-pixel conventions",
        ),
    ]  # fmt: skip
    return report


def _add_tables(
    report: Report, stages: Stages, networks: dict[str, float], per_second: dict[str, float], solve_ms: float
) -> None:
    rows = [
        [stage, f"{stages.ms(stage):.2f}", "picture"] for stage in ("decode", "crop", "follow", "message")
    ]
    rows += [[f"network {name}", f"{ms:.2f}", "picture"] for name, ms in networks.items()]
    rows.append(["lattices, inverse kinematics, smoothing", f"{solve_ms:.2f}", "instant of 4 cameras"])
    report.tables.append("Processor time by stage, one thread each:\n\n" + table(["stage", "ms", "a"], rows))
    report.figures += [
        Figure(
            f"frames_per_s_{name}", value, "1/s", ">=15" if name != "heavy" else "",
            "4 cameras of 1088×1920 on 2 cores, all stages: by processor time",
        )
        for name, value in per_second.items()
    ]  # fmt: skip
    report.figures.append(
        Figure("solve_ms", solve_ms, "ms", "", "all that follows the heat maps, an instant")
    )


def _rates(name: str, measured: tuple[float, float], target: str, note: str) -> list[Figure]:
    """What one and two people are solved at."""
    by_clock, by_processor = measured
    return [
        Figure(f"{name}_frames_per_s", by_clock, "1/s", target, f"{_CLOCK}: by the clock{note}"),
        Figure(
            f"{name}_processor_frames_per_s", by_processor, "1/s", "",
            f"the same by the processor time of all processes, {_CORES} cores kept busy by nothing else",
        ),
    ]  # fmt: skip


def _by_the_clock(cameras: Sequence[Camera], tasks: Sequence[CameraTask], people: int) -> tuple[float, float]:
    """Instants a second that come out solved, by the clock and by processor time, after the first ones, which
    compile and measure the people. Several are followed as before served cameras."""
    video = VideoSetUp(tuple(cameras), "full")
    with CameraRig(video, tasks, RigOptions(people=people)) as rig:
        filmed = FilmedPeople(video, rig.rate_hz)
        instants = enumerate(rig)
        for _, instant in itertools.islice(instants, _FIRST):
            filmed.add(instant)
        if len(filmed.people) != people:
            raise GatewayError(f"{len(filmed.people)} people in the first {_FIRST} pictures, not {people}")
        pipelines = {
            number: _pipeline(cameras, messages, rig.rate_hz)
            for number, messages in enumerate(filmed.people, start=1)
        }
        stages = {number: _stage(pipeline) for number, pipeline in pipelines.items()}
        if isinstance(rig.people, LiveCrowd):
            for number, stage in stages.items():
                rig.people.solved_by(number, stage.reconstructor)
        else:
            rig.people = _Led(stages[1])
        began, used = time.perf_counter(), _processor_s()
        for index, instant in itertools.islice(instants, _TIMED):
            for number, messages in instant.messages.items():
                pipelines[number].feed(Chunk(b"".join(messages), round(index * 1e9 / rig.rate_hz), LINK))
        spent, used = time.perf_counter() - began, _processor_s() - used
    return _TIMED / spent, _CORES * _TIMED / used


class _Led:
    """Cameras led by what solves their one person, as those are that serve a gateway."""

    def __init__(self, stage: CameraStage) -> None:
        self._stage = stage

    def take(self, messages: Sequence[bytes]) -> CrowdInstant:
        """Pass an instant on."""
        return CrowdInstant(messages={1: messages}, orders=self._stage.orders())


def _stage(pipeline: Pipeline) -> CameraStage:
    stage = pipeline.stage_of(HeatMapFrame)
    assert isinstance(stage, CameraStage)
    return stage


def _processor_s() -> float:
    """Of this process and those that it has started."""
    here = psutil.Process()
    times = [each.cpu_times() for each in (here, *here.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


def _known(cameras: Sequence[Camera], instants: list[list[bytes]]) -> FloatArray:
    """Where the person is, (n, n_keypoints, 3) m."""
    keypoints = load_keypoint_set("blazepose_33")
    reconstructor = VideoReconstructor(cameras, keypoints)
    return np.array(
        [reconstructor.update(heat_map_frame(t, each)).keypoints for t, each in enumerate(instants)]
    )


def _cameras() -> tuple[list[Camera], list[str]]:
    cameras, places = [], []
    for camera in load_cameras(DATA / "calibration" / "Calib.qca.txt"):
        place = str(DATA / "videos" / f"{camera.name}.mp4")
        info = open_pictures(place).info
        cameras.append(fitted(camera, info.width, info.height, SizeChange.SCALED))
        places.append(place)
    return cameras, places


def _looked_at(camera: Camera, place: str, stages: Stages) -> list[bytes]:
    """The messages of one camera, with the time of every stage."""
    network, detector = load_network("full"), PersonDetector()
    pictures = iter(open_pictures(place))
    region: PersonRegion | None = None
    messages = []
    for sequence in range(INSTANTS):
        time_ns, picture = stages.timed("decode", lambda: next(pictures))
        if region is None:
            region = detector.people(picture)[0].region
        affine = region.affine(_CROP)
        stages.timed("crop", lambda p=picture, a=affine: cropped(p, a, _CROP))  # type: ignore[misc]
        maps = network.heat_maps(picture, region)
        region = stages.timed("follow", lambda m=maps: region_of_maps(m, network.keypoints))  # type: ignore[misc]
        messages.append(
            stages.timed(
                "message",
                lambda m=maps, s=sequence, t=time_ns: encode_heat_maps(  # type: ignore[misc]
                    HeatMapMessage(camera.name, "full", s, t, quantised(m.likelihood), m.map_from_pixel)
                ),
            )
        )
    return messages


def _network_ms(place: str, name: str) -> float:
    """One run of a network without the crop, ms."""
    network = load_network(name)
    picture, region = _first(place)
    stages = Stages()
    for _ in range(_NETWORK_PICTURES):
        stages.timed("all", lambda: network.heat_maps(picture, region))
        stages.timed("crop", lambda: cropped(picture, region.affine(_CROP), _CROP))
    return stages.ms("all") - stages.ms("crop")


def _first(place: str) -> tuple[Picture, PersonRegion]:
    _, picture = next(iter(open_pictures(place)))
    return picture, PersonDetector().people(picture)[0].region


def _solve_ms(cameras: list[Camera], instants: list[list[bytes]], rate: float) -> float:
    """All that follows the heat maps, ms an instant, after compiling."""
    pipeline = _pipeline(cameras, instants, rate)
    stages = Stages()
    for chunk in video_chunks(instants, rate):
        stages.timed("solve", lambda c=chunk: pipeline.feed(c))  # type: ignore[misc]
    return stages.ms("solve")


def _pipeline(cameras: Sequence[Camera], instants: list[list[bytes]], rate: float) -> Pipeline:
    suit = video_suit(cameras, "full", instants)
    pipeline = Pipeline.from_settings(video_settings("benchmark", rate), suit)
    pipeline.add_link(LINK, "heat_maps")
    return pipeline


def _mirrored_offset(place: str) -> float:
    """Median cells between peaks in mirrored pictures and the mirrored peaks, across."""
    network = load_network("full")
    swapped = [network.keypoints.index(_other_side(name)) for name in network.keypoints]
    off: list[float] = []
    for _, picture in itertools.islice(open_pictures(place), 0, 10 * _MIRRORED, 10):
        region = PersonDetector().people(picture)[0].region
        off += _mirrored(network, picture, region, swapped).tolist()
    return abs(float(np.median(off)))


def _mirrored(network: PoseNetwork, picture: Picture, region: PersonRegion, swapped: list[int]) -> np.ndarray:
    across = picture.shape[1] - 1
    other = PersonRegion(np.array([across - region.centre[0], region.centre[1]]), region.size, -region.roll)
    there, likely = peaks(network.heat_maps(picture, region))
    back, likely_back = peaks(network.heat_maps(np.ascontiguousarray(picture[:, ::-1]), other))
    sure = np.minimum(likely, likely_back[swapped]) > 0.6
    cell = region.size / 64
    distance = (there[:, 0] + back[swapped, 0] - across)[sure] / cell
    return distance[np.abs(distance) < 4] / 2


def _other_side(name: str) -> str:
    return name.replace("left", "@").replace("right", "left").replace("@", "right")
