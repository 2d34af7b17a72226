"""Readers of public layouts, on small samples written here in the layouts' own terms."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from isdf import DatasetError, FrameError, IsdfConfig, PinholeCamera
from isdf.datasets import (
    DepthSequence,
    PolycamSequence,
    RecordedSequence,
    ReplicaCadSequence,
    ReplicaSequence,
    ScanNetSequence,
    SequenceWriter,
    SevenScenesSequence,
    TumSequence,
    open_sequence,
)
from isdf.datasets.poses import poses_at
from isdf.runner import run_every_frame

CAMERA = PinholeCamera(20.0, 21.0, 7.5, 5.0, 16, 12)


def make_poses(count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        poses[i, :3, :3] = Rotation.from_rotvec([0.1 * i, 0.4 + 0.05 * i, -0.2]).as_matrix()
        poses[i, :3, 3] = [0.3 * i, 1.0 - 0.1 * i, 0.5]
    return poses


def make_depths(count: int, width: int = 16, height: int = 12) -> np.ndarray:
    """Ramps in x and y, so that a transposed or shifted image is noticed; one pixel is invalid."""
    x, y = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    depths = np.stack([1.0 + 0.2 * i + 0.5 * x + 0.25 * y for i in range(count)])
    depths[:, 2, 3] = 0.0
    return depths


def save_png(path: Path, depth: np.ndarray, scale: float, invalid: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.rint(depth * scale)
    values[depth == 0] = invalid
    Image.fromarray(values.astype(np.uint16)).save(path)


def save_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix, fmt="%f")


def assert_reads(sequence: DepthSequence, depths: np.ndarray, poses: np.ndarray, atol: float = 1e-3) -> None:
    assert isinstance(sequence, DepthSequence) and len(sequence) == len(depths)
    assert sequence.poses.shape == (len(depths), 4, 4)
    for i, (depth, pose) in enumerate(zip(depths, poses, strict=True)):
        frame = sequence[i]
        torch.testing.assert_close(frame.depth, torch.from_numpy(depth).float(), atol=atol, rtol=0)
        assert torch.equal(frame.depth == 0, torch.from_numpy(depth == 0))
        torch.testing.assert_close(frame.T_world_camera, torch.from_numpy(pose), atol=2e-6, rtol=0)


def write_replica(folder: Path, scale: float = 6553.5, shared: bool = True) -> None:
    for i, depth in enumerate(make_depths(3)):
        save_png(folder / "results" / f"depth{i:06d}.png", depth, scale)
    np.savetxt(folder / "traj.txt", make_poses(3).reshape(3, 16))
    c = CAMERA
    values = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": scale}
    place = folder.parent if shared else folder
    (place / "cam_params.json").write_text(json.dumps({"camera": values}))


def write_scannet(folder: Path, numbers=(0, 1, 2), frames: str = "frames") -> None:
    root = folder / frames
    for number, depth, pose in zip(numbers, make_depths(3), make_poses(3), strict=True):
        save_png(root / "depth" / f"{number}.png", depth, 1000.0)
        save_matrix(root / "pose" / f"{number}.txt", pose)
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    save_matrix(root / "intrinsic" / "intrinsic_depth.txt", K)


def write_seven_scenes(folder: Path, numbers=(0, 1, 2)) -> np.ndarray:
    depths = make_depths(3, 640, 480)
    for number, depth, pose in zip(numbers, depths, make_poses(3), strict=True):
        save_png(folder / f"frame-{number:06d}.depth.png", depth, 1000.0, invalid=65535)
        rows = ["\t ".join(f"{v: .7e}" for v in row) + "\t " for row in pose]
        (folder / f"frame-{number:06d}.pose.txt").write_text("\n".join(rows) + "\n")
    return depths


def write_tum(folder: Path, start: float = 1305031102.0) -> np.ndarray:
    """Images at 30 Hz; a camera that moves and turns steadily, its poses at 100 Hz and between the images."""
    depths = make_depths(3, 640, 480)
    lines = ["# depth maps", "# file: 'rgbd_dataset_freiburg1_desk.bag'", "# timestamp filename"]
    for i, depth in enumerate(depths):
        stamp = f"{start + i / 30:.6f}"
        save_png(folder / "depth" / f"{stamp}.png", depth, 5000.0)
        lines.append(f"{stamp} depth/{stamp}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    truth = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for t in np.arange(-0.037, 0.11, 0.01):
        pose = steady_motion(t)
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        truth.append(f"{start + t:.6f} " + " ".join(f"{v:.9f}" for v in (*pose[:3, 3], *quaternion)))
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    return depths


def write_polycam(folder: Path, cameras: str = "corrected_cameras") -> None:
    """Depth of 16 x 12 beside colour of 64 x 48; a camera that looks along -z with y up; stamps in microseconds."""
    for i, (depth, pose) in enumerate(zip(make_depths(3), make_poses(3), strict=True)):
        stamp = 5_000_000 + 500_000 * i
        save_png(folder / "keyframes" / "depth" / f"{stamp}.png", depth, 1000.0)
        trust = np.full(depth.shape, 255, dtype=np.uint8)
        trust[5, 6], trust[5, 7] = 0, 127
        (folder / "keyframes" / "confidence").mkdir(exist_ok=True)
        Image.fromarray(trust).save(folder / "keyframes" / "confidence" / f"{stamp}.png")
        turned = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        values = {f"t_{r}{c}": turned[r, c] for r in range(3) for c in range(4)}
        values |= {"fx": 80.0 + i, "fy": 84.0, "cx": 31.5, "cy": 21.5, "width": 64, "height": 48}
        (folder / "keyframes" / cameras).mkdir(exist_ok=True)
        (folder / "keyframes" / cameras / f"{stamp}.json").write_text(json.dumps(values))


def steady_motion(t: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(t * np.array([0.3, 2.0, 0.1])).as_matrix()
    pose[:3, 3] = np.array([1.0, 2.0, 0.5]) + t * np.array([0.8, -0.4, 0.1])
    return pose


def test_replica_reads_its_camera_from_the_folder_above(tmp_path, monkeypatch) -> None:
    write_replica(tmp_path / "Replica" / "room0")
    sequence = ReplicaSequence(tmp_path / "Replica" / "room0")
    assert sequence.camera == CAMERA and sequence.fps == 30.0
    assert_reads(sequence, make_depths(3), make_poses(3))
    assert [f.time for f in sequence] == pytest.approx([0, 1 / 30, 2 / 30])
    monkeypatch.chdir(tmp_path / "Replica" / "room0")
    assert isinstance(open_sequence("."), ReplicaSequence)


def test_replica_faults_name_the_file(tmp_path) -> None:
    write_replica(tmp_path, shared=False)
    parameters = tmp_path / "cam_params.json"
    good = parameters.read_text()
    for text, fault in (
        ("{", "Expecting"),
        ("{}", "camera"),
        (good.replace("6553.5", "0"), "scale must be positive"),
        (good.replace('"h": ', '"h": 1e999, "_": '), "infinity"),
    ):
        parameters.write_text(text)
        with pytest.raises(DatasetError, match=rf"cam_params\.json: .*{fault}"):
            ReplicaSequence(tmp_path)
    parameters.write_text(good)
    (tmp_path / "traj.txt").write_text("1 0 0\n")
    with pytest.raises(DatasetError, match=r"traj\.txt: expected rows of 16"):
        ReplicaSequence(tmp_path)
    np.savetxt(tmp_path / "traj.txt", make_poses(2).reshape(2, 16))
    with pytest.raises(DatasetError, match=r"2 poses, but depth000002\.png needs line 3"):
        ReplicaSequence(tmp_path)


def test_replica_cad_reads_noisy_or_clean_depth_with_the_released_camera(tmp_path) -> None:
    folder, clean = tmp_path / "apt_2_nav", make_depths(2, 1200, 680)
    for i, depth in enumerate(clean):
        save_png(folder / "results" / f"depth{i:06d}.png", depth, 3276.75)
        save_png(folder / "results" / f"ndepth{i:06d}.png", depth * 1.1, 3276.75)
    np.savetxt(folder / "traj.txt", make_poses(2).reshape(2, 16))
    assert_reads(ReplicaCadSequence(folder), clean * 1.1, make_poses(2))
    assert_reads(ReplicaCadSequence(folder, noisy=False), clean, make_poses(2))
    (tmp_path / "cam_params.json").write_text("{}")  # of other sequences in the same folder
    sequence = open_sequence(folder)
    assert isinstance(sequence, ReplicaCadSequence)
    assert sequence.camera == PinholeCamera(600.0, 600.0, 599.5, 339.5, 1200, 680)


def test_unmarked_results_are_refused_since_their_scale_is_unknown(tmp_path) -> None:
    write_replica(tmp_path, shared=False)
    (tmp_path / "cam_params.json").unlink()
    with pytest.raises(DatasetError, match=r"results/ndepth%06d\.png; .*: cam_params\.json"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("frames", ["frames", "."])
def test_scannet_reads_with_and_without_frames_folder(tmp_path, frames) -> None:
    write_scannet(tmp_path / "scene0031_00", frames=frames)
    sequence = open_sequence(tmp_path / "scene0031_00")
    assert isinstance(sequence, ScanNetSequence) and sequence.camera == CAMERA and sequence.fps == 30.0
    assert_reads(sequence, make_depths(3), make_poses(3))


def test_scannet_frames_are_in_order_of_number_and_keep_their_time(tmp_path) -> None:
    write_scannet(tmp_path, numbers=(5, 10, 15))  # as text, 10 would come first
    sequence = ScanNetSequence(tmp_path)
    assert_reads(sequence, make_depths(3), make_poses(3))
    assert sequence.fps == pytest.approx(6.0) and sequence[2].time == pytest.approx(10 / 30)
    assert ScanNetSequence(tmp_path, fps=10.0)[2].time == pytest.approx(0.2)


def test_scannet_poses_and_intrinsics_of_the_isdf_release(tmp_path) -> None:
    scene = tmp_path / "scene0031_00"
    write_scannet(scene)
    for path in (
        *(scene / "frames" / "pose").iterdir(),
        scene / "frames" / "intrinsic" / "intrinsic_depth.txt",
    ):
        path.unlink()
    np.savetxt(scene / "traj.txt", make_poses(3).reshape(3, 16))
    lines = "axisAlignment = 1 0 0 0\nfx_depth = 20.0\nfy_depth = 21.0\nmx_depth = 7.5\nmy_depth = 5.0\n"
    (scene / "scene0031_00.txt").write_text(lines)
    sequence = open_sequence(scene)
    assert sequence.camera == CAMERA
    assert_reads(sequence, make_depths(3), make_poses(3))
    (scene / "scene0031_00.txt").write_text(lines.replace("mx_depth", "other"))
    with pytest.raises(DatasetError, match=r"scene0031_00\.txt: 'mx_depth' missing"):
        open_sequence(scene)


def test_frames_where_tracking_was_lost_are_refused_and_passed_over(tmp_path) -> None:
    write_scannet(tmp_path)
    save_matrix(tmp_path / "frames" / "pose" / "0.txt", np.full((4, 4), -np.inf))
    assert (tmp_path / "frames" / "pose" / "0.txt").read_text().startswith("-inf")
    sequence = ScanNetSequence(tmp_path)
    with pytest.raises(FrameError, match="NaN or inf"):
        sequence[0]
    mapper, report = run_every_frame(sequence, IsdfConfig(), 1, lambda *_: None)
    assert list(report.frames_refused) == [0] and mapper.frames_seen == 2
    (tmp_path / "frames" / "pose" / "1.txt").unlink()
    with pytest.raises(FrameError, match="NaN or inf"):
        ScanNetSequence(tmp_path)[1]
    (tmp_path / "frames" / "pose" / "2.txt").write_text("1 0 0 zero")
    with pytest.raises(DatasetError, match=r"pose/2\.txt: could not convert"):
        ScanNetSequence(tmp_path)


def test_seven_scenes(tmp_path) -> None:
    depths = write_seven_scenes(tmp_path)
    sequence = open_sequence(tmp_path)
    assert isinstance(sequence, SevenScenesSequence)
    assert sequence.camera == PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
    assert_reads(sequence, depths, make_poses(3))


def test_a_calibration_beside_the_frames_overrules_the_nominal_one(tmp_path) -> None:
    write_seven_scenes(tmp_path, numbers=(0, 3, 6))
    save_matrix(tmp_path / "camera-intrinsics.txt", np.array([[570.0, 0, 319], [0, 571, 239], [0, 0, 1]]))
    sequence = SevenScenesSequence(tmp_path)
    assert sequence.camera == PinholeCamera(570.0, 571.0, 319.0, 239.0, 640, 480)
    assert sequence.fps == pytest.approx(10.0)
    save_matrix(tmp_path / "camera-intrinsics.txt", np.zeros((3, 3)))
    with pytest.raises(DatasetError, match=r"camera-intrinsics\.txt: focal lengths"):
        SevenScenesSequence(tmp_path)


def test_a_scene_of_several_sequences_says_which_to_give(tmp_path) -> None:
    (tmp_path / "chess" / "seq-02").mkdir(parents=True)
    with pytest.raises(DatasetError, match="it holds seq-02: give one of them"):
        open_sequence(tmp_path / "chess")


def test_tum_poses_are_interpolated_at_the_images_stamps(tmp_path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg1_desk"
    depths = write_tum(folder)
    sequence = open_sequence(folder)
    assert isinstance(sequence, TumSequence) and sequence.camera.fx == 517.3
    assert sequence.fps == pytest.approx(30.0, rel=1e-3)
    assert_reads(sequence, depths, np.stack([steady_motion(i / 30) for i in range(3)]))
    nearest = TumSequence(folder, interpolate=False).poses
    # The nearest pose is up to half a sample away, never on the spot here.
    gap = np.linalg.norm(nearest[:, :3, 3] - sequence.poses[:, :3, 3], axis=1)
    assert (gap > 1e-4).all() and (gap < 0.005).all()


@pytest.mark.parametrize(
    ("name", "fx"), [("rgbd_dataset_freiburg2_xyz", 520.9), ("seq_tum_fr3_cabinet", 535.4)]
)
def test_tum_camera_is_chosen_by_the_name(tmp_path, name, fx) -> None:
    write_tum(tmp_path / name)
    assert TumSequence(tmp_path / name).camera.fx == fx


def test_tum_faults_and_images_without_a_pose(tmp_path) -> None:
    write_tum(tmp_path / "desk")
    with pytest.raises(DatasetError, match="freiburg1"):
        open_sequence(tmp_path / "desk")
    camera = PinholeCamera(500.0, 500.0, 319.5, 239.5, 640, 480)
    assert TumSequence(tmp_path / "desk", camera=camera).camera == camera
    truth = tmp_path / "desk" / "groundtruth.txt"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join(lines[:6]))  # up to 7 ms before the first image
    sequence = TumSequence(tmp_path / "desk", camera=camera)
    assert np.isfinite(sequence.poses).all(axis=(1, 2)).tolist() == [True, False, False]
    with pytest.raises(FrameError, match="NaN or inf"):
        sequence[1]
    with pytest.raises(DatasetError, match=r"no depth image has a pose within 0\.001 s"):
        TumSequence(tmp_path / "desk", camera=camera, tolerance=0.001)
    (tmp_path / "desk" / "depth.txt").write_text("# only\n12.5\n")
    with pytest.raises(DatasetError, match=r"depth\.txt:2: expected a time stamp and a file name"):
        TumSequence(tmp_path / "desk", camera=camera)


@pytest.mark.parametrize("cameras", ["corrected_cameras", "cameras"])
def test_polycam_turns_the_camera_and_scales_its_intrinsics(tmp_path, cameras) -> None:
    write_polycam(tmp_path, cameras)
    sequence = open_sequence(tmp_path)
    assert isinstance(sequence, PolycamSequence) and sequence.fps == pytest.approx(2.0)
    depths = make_depths(3)
    depths[:, 5, 6] = 0.0  # of low confidence
    assert_reads(sequence, depths, make_poses(3))
    assert sequence[1].time == pytest.approx(0.5)
    # The middle of the colour image's columns is the middle of the depth image's.
    assert sequence[0].camera == PinholeCamera(20.0, 21.0, 7.5, 5.0, 16, 12)
    assert sequence[2].camera.fx == pytest.approx(82.0 / 4)


def test_polycam_faults_and_depth_out_of_range(tmp_path) -> None:
    write_polycam(tmp_path)
    folder = tmp_path / "keyframes"
    save_png(folder / "depth" / "5000000.png", np.full((12, 16), 5.5), 1000.0)
    with pytest.raises(FrameError, match="valid"):
        PolycamSequence(tmp_path)[0]
    Image.fromarray(np.ones((6, 8), dtype=np.uint8)).save(folder / "confidence" / "5500000.png")
    with pytest.raises(DatasetError, match=r"confidence/5500000\.png: has shape \(6, 8\)"):
        PolycamSequence(tmp_path)[1]
    (folder / "corrected_cameras" / "5000000.json").write_text('{"fx": 80}')
    with pytest.raises(DatasetError, match=r"5000000\.json: 'fy' missing"):
        PolycamSequence(tmp_path)
    (folder / "corrected_cameras" / "5000000.json").write_text('{"fx": 1' + "0" * 400 + "}")
    with pytest.raises(DatasetError, match=r"5000000\.json: .*too large"):
        PolycamSequence(tmp_path)
    for path in (folder / "corrected_cameras").iterdir():
        path.rename(path.with_name("7" + path.name))
    with pytest.raises(DatasetError, match="no depth image has the name of a camera file"):
        PolycamSequence(tmp_path)


def test_poses_between_stamps() -> None:
    stamps = np.array([2.0, 0.0, 1.0, 1.0, 3.0])
    poses = np.stack([steady_motion(t) for t in stamps])
    poses[4] = np.nan
    times = np.array([0.25, 1.0, 1.9, 2.05, 2.5])
    found = poses_at(times, stamps, poses, tolerance=0.3)
    np.testing.assert_allclose(found[:3], np.stack([steady_motion(t) for t in times[:3]]), atol=1e-12)
    np.testing.assert_allclose(found[3], steady_motion(2.0), atol=1e-12)  # held, not extrapolated
    assert np.isnan(found[4]).all()
    single = poses_at(np.array([0.1]), stamps[1:2], poses[1:2], tolerance=0.2)
    np.testing.assert_allclose(single[0], steady_motion(0.0))
    assert np.isnan(poses_at(times, stamps[:0], poses[:0], tolerance=1.0)).all()


def test_the_recorded_folder_is_still_found_first(tmp_path) -> None:
    writer = SequenceWriter(tmp_path / "room", CAMERA, fps=5.0)
    for depth, pose in zip(make_depths(3), make_poses(3), strict=True):
        writer.write(depth, pose)
    sequence = open_sequence(tmp_path / "room")
    assert isinstance(sequence, RecordedSequence) and sequence.fps == 5.0
    assert open_sequence(tmp_path / "room", fps=2.0)[1].time == pytest.approx(0.5)
    assert_reads(sequence, make_depths(3), make_poses(3))


def test_an_unknown_folder_is_told_what_every_layout_misses(tmp_path) -> None:
    (tmp_path / "depth").mkdir()
    with pytest.raises(DatasetError) as info:
        open_sequence(tmp_path)
    text = str(info.value)
    for part in (
        "recorded folder: poses.txt, intrinsics.json;",
        "Replica (NICE-SLAM): results, traj.txt",
        "ScanNet export: depth/<n>.png, pose/<n>.txt, intrinsic/intrinsic_depth.txt;",
        "7-Scenes: frame-%06d.depth.png",
        "TUM RGB-D: depth.txt, groundtruth.txt;",
        "Polycam raw data: keyframes/depth/<t>.png, keyframes/corrected_cameras/<t>.json",
        "ROS bag: ",
    ):
        assert part in text
    with pytest.raises(DatasetError, match="no such file or folder"):
        open_sequence(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="fps must be positive"):
        write_scannet(tmp_path / "scene")
        open_sequence(tmp_path / "scene", fps=-1.0)
