"""The experiments' machinery on a ball in a box: whole results or none, the same by every backend, true tables."""

import importlib.util
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import experiments, mapping, mapping_report, runs, tables
from benchmarks.experiments import METHODS, Clock, Job
from benchmarks.runs import Study, prepare, run
from benchmarks.stages import stage_times
from isdf import IsdfConfig, IsdfMapper, NetworkConfig, PinholeCamera, SamplingConfig
from isdf.datasets import SequenceWriter, open_sequence
from isdf.methods import load_map
from isdf.voxel import ExactConfig
from robots.simulation import Box, SceneField, Sphere, save_truth
from tests.isdf.rooms import look_at, render

SMALL = IsdfConfig(
    network=NetworkConfig(width=16),
    sampling=SamplingConfig(rays_per_frame=10, stratified=3, near_surface=2),
    first_frame_steps=4,
    steps_per_frame=2,
    keyframe_steps=1,
)
STEPS = Clock("steps", 20.0)


def solids() -> list:
    """A ball on the floor of a box of 4 x 4 x 2.4 m."""

    def at(x: float, y: float, z: float) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, 3] = x, y, z
        return pose

    walls = [
        Box(f"wall{i}", at(2.1 * x, 2.1 * y, 1.2), (4.2 if y else 0.2, 4.2 if x else 0.2, 2.4))
        for i, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)])
    ]
    slabs = [Box(f"slab{z}", at(0, 0, z), (4.4, 4.4, 0.2)) for z in (-0.1, 2.5)]
    return [*walls, *slabs, Sphere("ball", at(0.8, 0.5, 0.4), 0.4)]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A folder with one sequence of 16 frames in 1.6 s, its noise-free twin and its truth."""
    root = tmp_path_factory.mktemp("sequences")
    camera = PinholeCamera.from_fov(32, 24, math.radians(70))
    exact = SceneField(solids())
    writers = [SequenceWriter(root / "room" / part, camera, fps=10.0) for part in ("", "noise_free")]
    for i in range(16):
        target = (math.cos(0.1 * i), math.sin(0.1 * i), 0.9)
        frame = render(exact.distance, look_at((-0.5, -0.3, 1.2), target), camera, 0.1 * i)
        for writer in writers:
            writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    save_truth(root / "room" / "truth.json", solids(), np.array([[-2.0, -2, 0], [2, 2, 2.4]]))
    return root


@pytest.fixture
def study(recorded, tmp_path) -> Study:
    return Study(recorded, tmp_path / "out", points=400, period=0.8, data=recorded)


def job(**changes) -> Job:
    return replace(Job("bounds", "room", "isdf batch", SMALL, STEPS), **changes)


def test_a_run_leaves_a_whole_result_that_agrees_with_its_map(study) -> None:
    prepare(study, "room")
    values = json.loads(run(study, job()).read_text())
    assert [moment["time"] for moment in values["over_time"]] == [0.8, 1.6]
    assert values["report"]["steps"] == values["over_time"][-1]["steps"] >= 32
    truth = runs.read_truth(study.points_file("room", "01"))
    assert len(truth) == values["over_time"][-1]["visible"]["points"] == 400
    field = load_map(study.map_file(job())).field()
    error = (field.distance(truth.points) - truth.distance).abs().mean()
    assert values["over_time"][-1]["visible"]["sdf_error"] == pytest.approx(float(error), rel=1e-5)
    assert values["unseen"]["points"] == 100
    assert values["memory"]["field"] > 0 and values["cpu_per_second"] > 0
    assert values["stages_ms"]["step"] > values["stages_ms"]["forward"] > 0


def test_a_result_is_kept_until_its_configuration_changes(study) -> None:
    prepare(study, "room")
    path = run(study, job())
    first = path.stat().st_mtime_ns
    assert study.done(job()) and run(study, job()).stat().st_mtime_ns == first
    changed = job(config=replace(SMALL, learning_rate=0.002))
    assert not study.done(changed)
    assert json.loads(run(study, changed).read_text())["config"]["learning_rate"] == 0.002


def test_a_run_that_dies_while_writing_leaves_nothing(study, monkeypatch) -> None:
    prepare(study, "room")
    write = Path.write_text

    def dying(self: Path, text: str, *args, **kwargs):
        write(self, text[: len(text) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", dying)
    with pytest.raises(KeyboardInterrupt):
        run(study, job())
    monkeypatch.undo()
    assert not study.done(job()) and list(study.result(job()).parent.iterdir()) == []
    json.loads(run(study, job()).read_text())


def options(recorded, tmp_path, **changes) -> mapping.Options:
    plain = mapping.Options(
        experiments=("bounds",),
        sequences=recorded,
        data=None,
        out=tmp_path / "out",
        methods=("isdf batch", "isdf ray"),
        points=200,
        period=1.6,
    )
    return replace(plain, **changes)


def scores(folder: Path) -> dict:
    return {
        path.name: [json.loads(path.read_text())[part] for part in ("over_time", "unseen")]
        for path in folder.glob("bounds/*.json")
    }


BACKENDS = [
    ("loky", 2),
    pytest.param(
        "dask",
        2,
        marks=[
            pytest.mark.slow,
            pytest.mark.skipif(not importlib.util.find_spec("distributed"), reason="needs `distributed`"),
        ],
    ),
]


@pytest.mark.parametrize(("backend", "jobs"), BACKENDS)
def test_every_backend_gives_the_serial_result(recorded, tmp_path, monkeypatch, backend, jobs) -> None:
    few = [job(), job(method="isdf ray", config=replace(SMALL, bound="ray"))]
    monkeypatch.setitem(mapping.EXPERIMENTS, "bounds", lambda *_: few)
    assert mapping.main(options(recorded, tmp_path / "serial")) == []
    assert mapping.main(options(recorded, tmp_path / "other", backend=backend, jobs=jobs)) == []
    expected = scores(tmp_path / "serial" / "out")
    assert len(expected) == 2 and scores(tmp_path / "other" / "out") == expected


def test_a_missing_cluster_package_is_named(recorded, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit, match="pip install ray"):
        mapping.main(options(recorded, tmp_path, backend="ray"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"only": ("hall",)}, "no sequence hall.*only room"),
        ({"methods": ("octomap",)}, "isdf batch.*not octomap"),
        ({"experiments": ("real",)}, "ISDF_DATA_DIR"),
        ({"experiments": ()}, "name one experiment.*fidelity"),
    ],
)
def test_wrong_options_say_what_there_is(recorded, tmp_path, changes, words, monkeypatch) -> None:
    monkeypatch.delenv("ISDF_DATA_DIR", raising=False)
    with pytest.raises(SystemExit, match=words):
        mapping.main(options(recorded, tmp_path, **changes))


def test_results_of_other_points_are_not_mixed(recorded, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(mapping.EXPERIMENTS, "bounds", lambda *_: [job(method="isdf ray")])
    mapping.main(options(recorded, tmp_path, methods=("isdf ray",)))
    with pytest.raises(SystemExit, match="another --out"):
        mapping.main(options(recorded, tmp_path, points=300))


def test_a_map_that_fails_is_named_and_the_others_go_on(recorded, tmp_path, monkeypatch) -> None:
    prepared = options(recorded, tmp_path)
    nan = replace(SMALL, learning_rate=1e12)
    jobs = [job(method="isdf ray", config=nan), job(config=SMALL)]
    monkeypatch.setitem(mapping.EXPERIMENTS, "bounds", lambda *_: jobs)
    failed = mapping.main(prepared)
    assert len(failed) == 1 and "isdf_ray" in failed[0] and "Error" in failed[0]
    assert [p.name for p in (prepared.out / "bounds").glob("*.json")] == ["room__isdf_batch__0.json"]


def test_held_out_frames_judge_a_map_of_the_others(study) -> None:
    values = json.loads(
        run(
            study, job(experiment="real", method="exact", config=ExactConfig(voxel=0.08), clock=Clock())
        ).read_text()
    )
    assert values["held_out"]["rays"] == 40 and values["report"]["frames"] == 14
    assert values["held_out"]["median_error"] < 0.05 and values["held_out"]["blocked"] < 0.02


@pytest.mark.slow
def test_every_method_of_the_comparison_is_judged(recorded, tmp_path) -> None:
    assert mapping.main(options(recorded, tmp_path, experiments=("main",), methods=())) == []
    results = [json.loads(path.read_text()) for path in (tmp_path / "out" / "main").glob("*.json")]
    assert {result["method"] for result in results} == set(METHODS)
    for result in results:
        assert result["over_time"][-1]["visible"]["sdf_error"] < 0.5 and result["memory"]["field"] > 0
        assert bool(result["keyframes"]) == (result["method"] == "isdf")


def test_stages_sum_to_the_step_and_none_is_forgotten(recorded) -> None:
    mapper = IsdfMapper(SMALL)
    mapper.integrate(open_sequence(recorded / "room")[0])
    before = mapper.steps
    times = stage_times(mapper, 5)
    assert mapper.steps == before + 5
    assert times["step"] == pytest.approx(sum(v for k, v in times.items() if k != "step"))
    assert (
        all(times[stage] > 0 for stage in ("sampling", "bounds", "forward", "backward"))
        and times["other"] >= 0
    )


def test_tables_average_over_sequences_and_spread_over_seeds() -> None:
    def result(sequence: str, seed: int, error: float) -> dict:
        moments = [{"visible": {"sdf_error": error}} for _ in range(2)]
        unseen = {"points": 9 * (sequence == "a"), "sdf_error": 9 * error if sequence == "a" else None}
        return {"method": "isdf", "sequence": sequence, "seed": seed, "over_time": moments, "unseen": unseen}

    results = [result("a", 0, 0.01), result("b", 0, 0.03), result("a", 1, 0.03), result("b", 1, 0.05)]
    assert tables.spread(results, tables.at_end("sdf_error")) == pytest.approx((0.03, math.sqrt(2) * 0.01, 2))
    assert tables.cell(results, tables.over_time("sdf_error"), 100) == "3.00 ± 1.41"
    assert tables.cell(results, tables.unseen("sdf_error"), 100) == "18.00 ± 12.73"  # nothing is unseen in b
    results[0]["over_time"][0]["visible"] = None
    assert tables.over_time("sdf_error")(results[0]) is None
    assert "| a | 2.00 ± 1.41 / - |" in tables.by_sequence(results)


def test_bars_of_a_mean_are_of_seeds_that_have_every_sequence(tmp_path, monkeypatch) -> None:
    def result(sequence: str, method: str, seed: int, error: float) -> dict:
        moments = [{"visible": {"sdf_error": error}}]
        return {"method": method, "sequence": sequence, "seed": seed, "over_time": moments}

    drawn: dict = {}
    monkeypatch.setattr(mapping_report, "save_bars", lambda path, groups, label, spread: drawn.update(groups))
    whole = [result("a", "isdf batch", 0, 0.01), result("b", "isdf batch", 0, 0.03)]
    part = [result("a", "isdf batch", 1, 0.50), result("a", "isdf ray", 0, 0.02)]
    mapping_report._save_ablation(tmp_path / "bars.png", whole + part)
    assert drawn["mean"] == {"batch": pytest.approx(2.0), "ray": None}
    assert drawn["a"] == {"batch": pytest.approx(25.5), "ray": pytest.approx(2.0)}


def test_the_report_draws_everything_and_publishes_between_marks(recorded, tmp_path, monkeypatch) -> None:
    methods = {"isdf": SMALL, "exact": ExactConfig(voxel=0.08)}
    monkeypatch.setattr(experiments, "METHODS", methods)
    run_options = options(recorded, tmp_path, experiments=("main",), methods=())
    assert mapping.main(run_options) == []
    page = tmp_path / "docs" / "results.md"
    page.parent.mkdir()
    page.write_text(
        "# R\n<!-- main-summary -->\nold\n<!-- /main-summary -->\n![](images/results/bins.png)\nend\n"
    )
    written = mapping_report.main(mapping_report.Options(run_options.out, page, (0.5,), 0.1))
    assert {p.name for p in written} >= {"main_curves.png", "bins.png", "slices_room.png", "meshes_room.png"}
    for path in written:
        if path.suffix == ".png":
            assert np.asarray(Image.open(path).convert("L")).std() > 5, f"{path.name} is blank"
    text = page.read_text()
    assert "old" not in text and "| iSDF (ours) |" in text and text.endswith("end\n")
    assert [p.name for p in (page.parent / "images" / "results").iterdir()] == ["bins.png"]


def test_the_unmapped_are_judged_as_surfaces_and_the_region_is_shared(study, monkeypatch) -> None:
    prepare(study, "room")
    monkeypatch.setattr(runs, "REGION_OF", "exact")
    exact = job(experiment="main", method="exact", config=ExactConfig(voxel=0.08), clock=Clock())
    moment = json.loads(run(study, exact).read_text())["over_time"][-1]
    assert 0 <= moment["unmapped"] < 0.5
    assert moment["voxblox_region"]["points"] == round((1 - moment["unmapped"]) * 400)
    other = json.loads(run(study, job(method="isdf ray")).read_text())["over_time"][-1]
    assert other["voxblox_region"]["points"] == moment["voxblox_region"]["points"]


def test_evaluation_times_end_with_the_sequence(recorded) -> None:
    sequence = open_sequence(recorded / "room")
    assert runs.evaluation_times(sequence, 0.5) == pytest.approx([0.5, 1.0, 1.6])
    assert runs.evaluation_times(sequence, 5.0) == pytest.approx([1.6])
