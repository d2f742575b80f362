"""The tables of effects and attributes, and the machine-readable facts about extras."""

import re
import tomllib
from pathlib import Path

import pytest

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS, SETTINGS, Effect
from deepshade.errors import ConfigError, LimitError, MissingAttributeError, nearest
from deepshade.extras import extra_of, installed, module_of, packages
from deepshade.gbuffer.profiles import PROFILES, QUANTITIES, detect, match_rank

ROOT = Path(__file__).resolve().parents[2]

# the design's table of attributes, written out a second time
CANONICAL = {
    "position": "position.X position.Y position.Z",
    "normal": "normal.X normal.Y normal.Z",
    "normal_world": "normal_world.X normal_world.Y normal_world.Z",
    "normal_object": "normal_object.X normal_object.Y normal_object.Z",
    "depth": "Z",
    "focal": "focal.V",
    "view": "view.X view.Y view.Z",
    "view_angle": "view_angle.V",
    "diffuse": "diffuse.R diffuse.G diffuse.B",
    "specular": "specular.R specular.G specular.B",
    "gloss": "gloss.V",
    "scatter": "scatter.R scatter.G scatter.B",
    "light": "light.R light.G light.B",
    "light_diffuse": "light_diffuse.R light_diffuse.G light_diffuse.B",
    "motion": "motion.U motion.V",
}


def test_attributes_are_the_designs():
    assert {name: " ".join(a.channels) for name, a in ATTRIBUTES.items()} == CANONICAL


# the design's table of effects, written out a second time: inputs, background, trivial, settings
DESIGN = {
    "ao": ("N_s P_s", 1.0, 1.0, "radius"),
    "do": ("N_w N_s P_s", "shaded", "irradiance", "radius environment"),
    "ibl": ("N_w C_w R_diff R_spec R_gloss", "shaded", "diffuse", "environment"),
    "gi": ("N_s P_s L_diff", 0.0, 0.0, "radius"),
    "sss": ("P_s R_scatt L", "light", "light", ""),
    "dof": ("D_focal L", "shaded", "light", "focus aperture"),
    "mb": ("F L D_s", "shaded", "light", "shutter"),
    "aa": ("D_s L", "shaded", "light", ""),
    "full": (
        "N_w C_w R_diff R_spec R_gloss N_s P_s D_focal",
        "shaded",
        "ibl",
        "radius focus aperture environment",
    ),
}


def test_effects_are_the_designs():
    assert set(EFFECTS) == set(DESIGN)
    for name, (inputs, background, trivial, settings) in DESIGN.items():
        effect = EFFECTS[name]
        assert effect.name == name
        assert " ".join(ATTRIBUTES[i].symbol for i in effect.inputs) == inputs
        assert (effect.background, effect.trivial) == (background, trivial)
        layer = effect.trivial_layer or "position"
        assert layer in ATTRIBUTES or layer.removeprefix("reference_") in EFFECTS
        assert " ".join(effect.settings) == settings
        assert set(effect.settings) <= set(SETTINGS)
        assert effect.is_light == (name != "ao")
    per_channel = {name for name, effect in EFFECTS.items() if effect.per_channel}
    assert per_channel == {"gi", "sss", "dof", "mb", "aa"}


def test_what_is_measured_in_lengths_or_light_keeps_32_bits():
    wide = {name for name, a in ATTRIBUTES.items() if a.unit.storage == "float32"}
    assert {"position", "depth", "scatter", "light", "light_diffuse"} <= wide
    assert {"normal", "diffuse", "view"}.isdisjoint(wide)
    scaled = {name for name, a in ATTRIBUTES.items() if a.unit.scaled}
    assert scaled == {"position", "depth", "scatter"}


def test_an_effect_with_an_unknown_input_is_refused():
    with pytest.raises(ValueError, match="no attribute is called 'nornal'"):
        Effect("x", "X", ("nornal",), "")


def test_extras_agree_with_the_project_file():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = declared["optional-dependencies"] | {"": declared["dependencies"]}
    for extra in ("all", "dev", "fuzz", "scaling"):  # what nobody is advised to install
        del wanted[extra]
    expected = {
        extra: {re.split(r"[\[><=!~ ]", text)[0].lower() for text in requirements}
        for extra, requirements in wanted.items()
    }
    found = {extra: set(names) for extra, names in packages().items()}
    assert found == expected, "install again: the metadata is older than pyproject.toml"


def test_packages_are_imported_by_the_names_we_think():
    for package in {package for found in packages().values() for package in found}:
        assert installed(module_of(package)), package  # all extras are installed where tests run


def test_the_extra_of_a_module():
    assert extra_of("torch.nn") == "trainer"
    assert extra_of("PIL") == "service"
    assert extra_of("mitsuba") == extra_of("drjit") == "workers"
    assert extra_of("matplotlib.pyplot") == "report"
    assert extra_of("numpy") is None
    assert extra_of("pytest") is None


def test_profiles_name_known_quantities_and_sign_every_component():
    for profile in PROFILES.values():
        for source in profile.sources:
            assert source.quantity in QUANTITIES
            assert len(source.signs) in (0, QUANTITIES[source.quantity])


@pytest.mark.parametrize(
    ("header", "name"),
    [
        ({"generatedBy": "Mitsuba version 3.9.1"}, "mitsuba"),
        ({"arnold/version": "7"}, "arnold"),
        ({"cycles.View Layer.samples": "128"}, "blender"),
        ({"File": "D:\\helmet.blend"}, "blender"),
        ({"unreal/camera/curPos/x": "1"}, "unreal"),
        ({"deepshade:fov": 50.0}, None),
    ],
)
def test_detects_the_renderer(header, name):
    found = detect(header)
    assert (found.name if found else None) == name


@pytest.mark.parametrize(
    ("layer", "alias", "stem", "rank"),
    [
        ("normal", "normal", False, 0),
        ("ViewLayer.Normal", "Normal", False, 1),
        ("ViewLayer.Normal", "normal", False, 3),
        ("NORMAL", "normal", False, 2),
        ("FinalImageMovieRenderQueue_WorldDepth", "WorldDepth", False, 1),
        ("subnormal", "normal", False, None),
        ("crypto_N", "N", False, None),
        ("shot_N", "N", True, 1),
        ("shot_normal_0012", "normal", True, 1),
        ("shot_normal_world.0001", "normal_world", True, 1),
        ("shot_normal_world", "normal", True, None),
    ],
)
def test_match_rank(layer, alias, stem, rank):
    assert match_rank(layer, alias, from_stem=stem) == rank


def test_errors_say_what_and_what_to_do():
    limit = LimitError("pixels", 10_000, 100)
    assert "10,000 pixels" in str(limit)
    assert "Limits(pixels" in limit.fix
    missing = MissingAttributeError(["normal"], ["Nornal.X"], {"normal": ("Nornal",)})
    assert "'normal'" in str(missing)
    assert "Nornal.X" in str(missing)
    assert "--map normal=Nornal" in missing.fix
    config = ConfigError("raduis", ["radius", "fov"])
    assert "radius" in config.fix
    assert nearest("zzz", ["radius"]) is None
