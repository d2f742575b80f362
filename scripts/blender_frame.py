"""Renders a mesh with Blender's Cycles: a multi-layer EXR with the passes that deepshade reads.

    pip install bpy
    python scripts/blender_frame.py garage.gltf out.exr --eye 0.6 -1.2 1.55 --target -2.8 2.2 0.85

In Blender: View Layer Properties, Passes, Data: tick Z and Normal (and Position, Vector); Output
Properties: OpenEXR MultiLayer. A filter of one pixel's width keeps depth from mixing at edges.
"""

from __future__ import annotations

import argparse
import math

import bpy
from mathutils import Vector


def main() -> None:
    """The command. Coordinates are Blender's, z up; the angle is horizontal, in degrees."""
    parser = argparse.ArgumentParser(description="Renders a glTF mesh with its passes, in Cycles.")
    parser.add_argument("scene")
    parser.add_argument("output")
    parser.add_argument("--eye", type=float, nargs=3, required=True)
    parser.add_argument("--target", type=float, nargs=3, required=True)
    parser.add_argument("--fov", type=float, default=60.0)
    parser.add_argument("--samples", type=int, default=32)
    options = parser.parse_args()
    eye, target = Vector(options.eye), Vector(options.target)

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=options.scene)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens_unit, camera.data.angle = "FOV", math.radians(options.fov)
    camera.location, camera.rotation_euler = eye, (target - eye).to_track_quat("-Z", "Y").to_euler()
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "AREA"))
    lamp.data.energy, lamp.data.size, lamp.location = 300, 2, eye + Vector((0, 0, 1))
    for item in (camera, lamp):
        scene.collection.objects.link(item)
    scene.camera, scene.world = camera, bpy.data.worlds.new("world")

    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_position = True
    render = scene.render
    render.engine, scene.cycles.samples, scene.cycles.use_denoising = (
        "CYCLES",
        options.samples,
        True,
    )
    scene.cycles.pixel_filter_type, render.filter_size = "BOX", 0.01
    render.resolution_x, render.resolution_y, render.filepath = 768, 512, options.output
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
