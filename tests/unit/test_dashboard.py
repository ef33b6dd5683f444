"""The TensorBoard log of an evaluation: what it holds, read back by TensorBoard's own reader."""

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dsr.evaluation.results import sample_path
from dsr.evaluation.run_files import load_results, read_run
from dsr.geometry.surface import render
from dsr.pictures.depth_views import normals_seen_by
from dsr.report.dashboard import save_dashboard

SCENES = ("b", "a")


@pytest.fixture
def log(make_run, tmp_path):
    save_dashboard(read_run(make_run(tmp_path, scenes=SCENES)))
    return read(tmp_path)


def read(folder):
    accumulator = EventAccumulator(str(folder), size_guidance={"images": 0, "tensors": 0})
    return accumulator.Reload()


def scalars(log, tag):
    return {event.step: event.value for event in log.Scalars(tag)}


def test_scalars_are_the_scores_in_table_units(log, tmp_path):
    scores = load_results([tmp_path]).scores.set_index(["metric", "variant", "scene"])["value"]
    assert scalars(log, "RMSE_d/a") == {0: pytest.approx(1000 * scores["RMSE_d", "", "a"])}
    assert scalars(log, "DSSIM_v/b") == {0: pytest.approx(1000 * scores["DSSIM_v", "max", "b"])}
    assert scalars(log, "scene/BadPix_v_5/simgeo") == {
        number: pytest.approx(100 * scores["BadPix_v_5", "max", scene]) for number, scene in enumerate(SCENES)
    }
    assert scalars(log, "light/DSSIM_v/a") == {
        number: pytest.approx(1000 * scores["DSSIM_v", f"e{number}", "a"]) for number in (1, 2, 3, 4)
    }
    mean = 1000 * (scores["RMSE_v", "", "a"] + scores["RMSE_v", "", "b"]) / 2
    assert scalars(log, "score/RMSE_v") == {0: pytest.approx(mean)}


def test_picture_has_renderings_of_the_result_above_those_of_the_truth(log, tmp_path):
    (run,) = load_results([tmp_path]).runs
    encoded = np.frombuffer(log.Images("renderings/a")[0].encoded_image_string, np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    scene = run.sample("a")
    result, truth = (render(normals_seen_by(scene.camera, depth))[0] for depth in (run.prediction("a"), scene.depth))
    expected = torch.cat([torch.cat(list(result), dim=-1), torch.cat(list(truth), dim=-1)])
    np.testing.assert_allclose(picture[..., 0], 255 * expected.numpy(), atol=1.01)


def test_second_log_replaces_the_first(make_run, tmp_path):
    make_run(tmp_path, scenes=("s",))
    save_dashboard(read_run(tmp_path))
    save_dashboard(read_run(tmp_path))
    assert len(list(tmp_path.glob("events*"))) == 1
    assert not list(tmp_path.glob(".tensorboard*"))
    assert len(read(tmp_path).Scalars("score/RMSE_v")) == 1


def test_scene_that_is_not_stored_has_scores_and_no_picture(make_run, tmp_path):
    make_run(tmp_path, scenes=("s", "t"))
    sample_path(tmp_path, "t").unlink()
    save_dashboard(read_run(tmp_path))
    log = read(tmp_path)
    assert "RMSE_d/t" in log.Tags()["scalars"]
    assert set(log.Tags()["images"]) == {"renderings/s", "depth_error/s"}
