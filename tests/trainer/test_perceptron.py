"""The perceptron of a mesh: where it looks, how large it is, and what it learns."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from deepshade import circles as places
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade.files import sha256
from deepshade.manifest import Manifest, Shard
from deepshade_trainer import circles
from deepshade_trainer.export import export
from deepshade_trainer.formats import export_to
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.recipe import preset
from deepshade_trainer.run import Run
from deepshade_trainer.shaders.perceptron import uniform
from deepshade_trainer.training import train

SIZES = {"mlp-16x8": 3_716, "mlp-32x16": 8_452, "mlp-64x32": 20_996}  # of the paper's buffers


def data_set(folder, views=12, pixels=400):
    """Samples of a made-up mesh, which is the darker the more its normals point down."""
    from safetensors.numpy import save_file

    rng = np.random.default_rng(0)
    middle = rng.normal(size=(views, 3, 1, pixels))
    normal = middle + rng.normal(size=(views, 3, 16, pixels)) * rng.random((views, 1, 1, pixels))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    answer = 0.2 + 0.7 / (1 + np.exp(-4 * normal[:, 1].mean(1)))[:, None, None]
    folder.mkdir()
    tensors = {
        "normal_object": normal.astype(np.float16),
        "reference_ao": answer.astype(np.float16),
    }
    save_file(tensors, folder / "a.safetensors")
    records = [{"scene": "made.obj", "seed": k, "radius": 0.3} for k in range(views)]
    schema = {k: {"dtype": "float16", "shape": list(v.shape[1:])} for k, v in tensors.items()}
    shard = Shard("a.safetensors", sha256(folder / "a.safetensors"), records)
    Manifest({}, schema, [shard]).write(folder)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    root = tmp_path_factory.mktemp("perceptron")
    data = data_set(root / "data")
    run = Run(root / "run")
    recipe = preset("mlp-16x8", "ao").changed(steps=15)
    last = list(train(recipe, [data], run))[-1]
    bundle, _ = export(run, root / "models" / "ao" / "made", [data])
    return data, run, last, bundle


def test_points_lie_on_the_circle_counter_clockwise_from_the_right():
    found = places.offsets(10)
    assert found[0] == (10, 0) and found[4] == (0, -10)  # rows go down
    assert found[2] == (7, -7)
    assert all(abs(math.hypot(x, y) - 10) < 0.5 for x, y in found)
    assert len(set(found)) == places.POINTS
    assert set(places.offsets(0)) == {(0, 0)}


@pytest.mark.parametrize("name", SIZES)
def test_weights_are_as_many_as_the_papers(name):
    network = build(preset(name, "ao").network)
    assert 4 * sum(w.numel() for w in network.parameters()) == SIZES[name]
    assert network.halo == 10


def test_an_answer_is_that_of_the_matrices():
    network = build(preset("mlp-32x16", "ao").network)
    gbuffer = torch.nn.functional.normalize(torch.randn(1, 3, 24, 23), dim=1)
    answer = network(gbuffer).detach()
    for row, column in ((12, 11), (0, 0), (23, 15)):
        x = np.zeros(48)
        for k in range(16):  # places by the angle, without `offsets`
            turn = 2 * np.pi * k / 16
            there = row - round(10 * np.sin(turn)), column + round(10 * np.cos(turn))
            if 0 <= there[0] < 24 and 0 <= there[1] < 23:
                x[3 * k : 3 * k + 3] = gbuffer[0, :, there[0], there[1]]
        for layer in network.hidden:
            x = np.tanh(layer.weight[:, :, 0, 0].detach().numpy() @ x + layer.bias.detach().numpy())
        last = network.last.weight[0, :, 0, 0].detach().numpy() @ x + network.last.bias.item()
        assert float(answer[0, 0, row, column]) == pytest.approx(float(last), abs=1e-5)


def test_at_a_circle_of_0_only_the_pixel_itself_counts():
    network = build(preset("mlp-16x8", "ao").changed(network={"circle": 0}).network)
    even = torch.full((1, 3, 21, 21), 0.5)
    odd = even.clone()
    odd[:, :, 0, 0] = -1
    assert network.halo == 0
    assert (network(even)[0, 0, 1:] == network(odd)[0, 0, 1:]).all()
    wide = build(preset("mlp-16x8", "ao").network)
    wide.load_state_dict(network.state_dict())
    assert torch.allclose(wide(even)[0, 0, 10, 10], network(even)[0, 0, 10, 10], atol=1e-6)


def test_background_is_open():
    shader = Shader(EFFECTS["ao"], build(preset("mlp-16x8", "ao").network)).eval()
    gbuffer = torch.nn.functional.normalize(torch.randn(1, 3, 8, 8), dim=1)
    gbuffer[..., 4:] = 0
    answer = shader(gbuffer)
    assert (answer[..., 4:] == 1).all()
    assert not (answer[..., :4] == 1).all()


def test_training_learns_from_views_that_it_does_not_test_on(trained):
    data, run, last, bundle = trained
    figures = last.figures
    assert figures["test_rmse"] < 0.25 * figures["trivial_rmse"]
    parts = circles.parts([data], preset("mlp-16x8", "ao"))
    assert [part[0].shape[-1] for part in parts] == [6 * 400, 3 * 400, 3 * 400]
    assert [y.unique().numel() > 100 for _, y in parts] == [True] * 3
    assert bundle.inputs == ("normal_object",) and bundle.radius == pytest.approx(0.3)
    assert bundle.exact and bundle.halo == 10
    assert not list(train(preset("mlp-16x8", "ao").changed(steps=15), [data], run))  # it is done


def test_a_bundle_may_look_at_the_pixel_alone(trained, tmp_path):
    data, run, _, _ = trained
    bundle, _ = export(run, tmp_path / "ao" / "alone", [data], network={"circle": 0})
    assert bundle.halo == 0 and bundle.network["circle"] == 0
    with pytest.raises(ConfigError, match="needs other weights"):
        export(run, tmp_path / "ao" / "wide", [data], network={"widths": [32, 16]})


def test_the_uniform_buffer_is_the_layers_one_after_the_other(trained, tmp_path):
    *_, bundle = trained
    export_to(bundle, "glsl", tmp_path, "32x32")
    (content,) = tmp_path.glob("*/perceptron.f32")
    numbers = np.fromfile(content, "<f4")
    assert content.stat().st_size == SIZES["mlp-16x8"]
    assert (numbers == uniform(bundle)).all()
    network = build(preset("mlp-16x8", "ao").network)
    network.load_state_dict(Run(trained[1].folder).load()[0]["average"])
    first, second = network.hidden
    assert (numbers[:768].reshape(16, 48) == first.weight[:, :, 0, 0].detach().numpy()).all()
    assert (numbers[768:784] == first.bias.detach().numpy()).all()
    assert (numbers[784:912].reshape(8, 16) == second.weight[:, :, 0, 0].detach().numpy()).all()
    assert (numbers[920:928] == network.last.weight[0, :, 0, 0].detach().numpy()).all()
    assert numbers[928] == network.last.bias.item()


def test_pictures_are_refused(tmp_path, trained):
    folder = tmp_path / "pictures"
    data_set(folder, views=4)
    manifest = Manifest.read(folder)
    from safetensors.numpy import save_file

    tensors = {
        "normal_object": np.ones((4, 3, 8, 8), np.float16),
        "reference_ao": np.ones((4, 1, 8, 8), np.float16),
    }
    save_file(tensors, folder / "a.safetensors")
    shard = Shard("a.safetensors", sha256(folder / "a.safetensors"), manifest.shards[0].samples)
    Manifest({}, manifest.schema, [shard]).write(folder)
    with pytest.raises(DataError, match="holds pictures") as caught:
        circles.parts([folder], preset("mlp-16x8", "ao"))
    assert "--pixels" in caught.value.fix


def test_lbfgs_is_for_perceptrons(trained, tmp_path):
    with pytest.raises(ConfigError, match="all samples at once"):
        list(train(preset("balanced", "ao").changed(optimizer="lbfgs"), [], Run(tmp_path)))
