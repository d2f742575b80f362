"""A perceptron's shader under OpenGL: what its buffer is, and ONNX Runtime's numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from deepshade.bundles import write_config
from deepshade.effects import EFFECTS
from deepshade.errors import EngineError
from deepshade_report import programs
from deepshade_trainer.export import write_onnx
from deepshade_trainer.graph import session
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.recipe import preset
from deepshade_trainer.shaders.perceptron import write_uniform_shader

SIZES = {"mlp-16x8": 3_716, "mlp-32x16": 8_452, "mlp-64x32": 20_996}


def bundle_of(name, folder):
    """Random weights, for what is compared."""
    torch.manual_seed(1)
    network = build(preset(name, "ao").network)
    folder.mkdir(parents=True)
    graph = folder / "made.onnx"
    write_onnx(Shader(EFFECTS["ao"], network).eval(), graph)
    config = {
        "effect": "ao",
        "name": name,
        "inputs": network.attributes,
        "outputs": ("Y",),
        "radius": 1.0,
        "fov": 50.0,
        "size_multiple": 1,
        "halo": 10,
        "bytes_per_pixel": 400,
        "float32": ["shade"],
        "network": {"kind": "perceptron", "widths": network_widths(network), "circle": 10},
    }
    return write_config(folder, config, {}, graph=graph)


def network_widths(network):
    return [layer.out_channels for layer in network.hidden]


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("top_down", [True, False])
def test_the_shader_gives_onnx_runtimes_numbers(name, top_down, tmp_path):
    pytest.importorskip("moderngl")
    try:
        gl = programs.gl_context(330)
    except EngineError as error:
        pytest.skip(str(error))
    bundle = bundle_of(name, tmp_path / "ao" / name)
    vertex, fragment, weights = write_uniform_shader(bundle, tmp_path)
    assert weights.stat().st_size == SIZES[name]
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(3, 24, 31)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=0)
    normal[:, 4:9, 6:20] = 0
    wanted = session(bundle.model).run(None, {"gbuffer": normal[None]})[0][0, 0]

    rows = normal if top_down else normal[:, ::-1]
    height, width = normal.shape[1:]
    texture = gl.texture((width, height), 3, rows.transpose(1, 2, 0).tobytes(), dtype="f4")
    program = gl.program(vertex.read_text(), fragment.read_text())
    block = program["Perceptron"]
    padded = gl.buffer(weights.read_bytes().ljust(block.size, b"\0"))
    assert SIZES[name] <= block.size < SIZES[name] + 16  # some drivers round it up
    padded.bind_to_uniform_block(block.binding)
    program["reach"], program["down"] = 10.0, 1.0 if top_down else -1.0
    texture.use(0)
    target = gl.texture((width, height), 1, dtype="f4")
    gl.framebuffer([target]).use()
    gl.vertex_array(program, []).render(vertices=3)
    found = np.frombuffer(target.read(), np.float32).reshape(height, width)
    found = found if top_down else found[::-1]
    assert (wanted[4:9, 6:20] == 1).all() and wanted.std() > 0.05
    np.testing.assert_allclose(found, wanted, atol=1e-5)
