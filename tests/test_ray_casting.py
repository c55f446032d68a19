"""The renderer: rays hit what MuJoCo's rays hit, and pictures look like MuJoCo's.

P pictures of one batch, L links.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import SimulatorError
from envs.ray_casting import render
from envs.scene import Camera, Checker, Geometry, Light, Scene, scene_of
from pictures import psnr

DAYLIGHT = Light("head", diffuse=(0.0,) * 3, ambient=(1.0,) * 3)
TITLES = [envs.spec(name).title for name in envs.task_names() if name.startswith("brax/")]
# Decibels, of which 28 are the least for any task. Where most of a picture is white, a link that is
# missing or of another colour costs less than 28 leave, so more is asked for there.
LIKENESS = dict.fromkeys(TITLES, 28) | {
    "HalfCheetah": 34,
    "Hopper": 37,
    "Walker2D": 37,
    "InvertedPendulum": 38,
    "InvertedDoublePendulum": 30,
}

EVERYTHING = """
<mujoco>
  <visual>
    <global offwidth="96" offheight="96"/>
    <quality offsamples="0" shadowsize="0" numslices="64" numstacks="64"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="flat" rgb1=".7 .8 1" width="4" height="4"/>
    <texture name="squares" type="2d" builtin="checker" rgb1=".2 .3 .4" rgb2=".8 .8 .7"
     width="64" height="64"/>
    <material name="floor" texture="squares" texrepeat="{repeat}" texuniform="{uniform}"/>
    <material name="glossy" specular="0.9" shininess="0.25" rgba="1 .2 .1 1"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 0 4" dir="1 1 -2"/>
    <geom name="floor" type="plane" size="{size}" material="floor"/>
    <body name="a" pos="-1 0 .5" euler="20 30 40"><freejoint/>
      <geom type="box" size=".3 .2 .4" material="glossy"/></body>
    <body name="b" pos="0 0 .5" euler="60 10 40"><freejoint/>
      <geom type="cylinder" size=".3 .4" rgba=".2 1 .1 1"/></body>
    <body name="c" pos="1 0 .5" euler="60 80 40"><freejoint/>
      <geom type="ellipsoid" size=".2 .3 .5" rgba=".2 .2 1 1"/></body>
    <body name="d" pos="0 1 .8" euler="60 80 40"><freejoint/>
      <geom type="capsule" size=".2 .3" rgba=".8 .2 1 1"/>
      <geom type="sphere" size=".25" pos=".5 .2 0" rgba=".8 .8 .1 1"/>
      <geom type="mesh" mesh="tent" group="3"/></body>
  </worldbody>
</mujoco>
""".replace(
    "  </asset>",
    '    <mesh name="tent" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>\n  </asset>',
)


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def drawing(mujoco):
    """MuJoCo's pictures, where it can draw."""
    module = pytest.importorskip("envs.mujoco_pictures")
    try:
        module.pictures("InvertedPendulum", 8)
    except SimulatorError as error:
        pytest.skip(str(error))
    return module


def everything(mujoco, repeat="3 3", uniform="false", size="3 2 1"):
    """A model of all that can be drawn, and its links' poses."""
    xml = EVERYTHING.format(repeat=repeat, uniform=uniform, size=size)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def poses(data):
    return np.asarray(data.xpos[1:], np.float32), np.asarray(data.xquat[1:], np.float32)


def ball(**camera) -> Scene:
    sphere = Geometry("sphere", (0.5, 0.0, 0.0), (0.8, 0.4, 0.2), link=0)
    return Scene((sphere,), Camera(**camera))


ORIGIN = np.zeros((1, 3), np.float32), np.float32([[1, 0, 0, 0]])


# Hits


@pytest.mark.parametrize("seed", [0, 1])
def test_each_pixel_shows_what_mujocos_ray_hits(mujoco, seed):
    """All kinds of geometries, turned at random, seen from a random side."""
    model, data = everything(mujoco)
    rng = np.random.default_rng(seed)
    data.qpos.reshape(4, 7)[:, 3:] = rng.normal(size=(4, 4))
    mujoco.mj_forward(model, data)
    scene = scene_of(model)
    camera = replace(
        scene.camera,
        azimuth=float(rng.uniform(0, 360)),
        elevation=float(rng.uniform(-60, -10)),
        distance=4.0,
    )
    # Each geometry has a colour of its own, and shows it in any light.
    colours = [(40 * (index + 1) / 255, 0.0, 0.0) for index in range(6)]
    scene = replace(
        scene,
        camera=camera,
        lights=(DAYLIGHT,),
        geometries=tuple(
            replace(geometry, colour=colour, checker=None)
            for geometry, colour in zip(scene.geometries, colours, strict=True)
        ),
    )
    image = np.asarray(render(scene, *poses(data), size=48))
    shown = image[..., 0].astype(int) // 40 - 1
    shown[(image == np.round(255 * np.array(scene.sky))).all(-1)] = -1

    axes = camera.axes()
    eye = np.array(camera.target) - camera.distance * axes[:, 2]
    across = (2 * (np.arange(48) + 0.5) / 48 - 1) * np.tan(np.radians(45 / 2))
    hit = np.full((48, 48), -1)
    found = np.zeros(1, np.int32)
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    for row, up in enumerate(-across):
        for column, right in enumerate(across):
            ray = axes @ [right, up, 1.0]
            ray /= np.linalg.norm(ray)
            mujoco.mj_ray(model, data, eye, ray, groups, 1, -1, found, None)
            hit[row, column] = found[0]
    assert len(np.unique(hit)) == 6 + (hit == -1).any(), "all of them are in the picture"
    assert (shown == hit).mean() > 0.998


def test_a_ball_covers_the_disc_that_geometry_says(mujoco):
    """A ball of radius r at distance d fills a cone of angle asin(r / d)."""
    image = np.asarray(render(replace(ball(), lights=(DAYLIGHT,)), *ORIGIN, size=200))
    shown = (image != 255).any(-1).sum()
    radius = 100 * np.tan(np.arcsin(0.5 / 2)) / np.tan(np.radians(30))
    assert shown == pytest.approx(np.pi * radius**2, rel=0.005)
    assert image[100, 100].tolist() == [204, 102, 51]


# Light


def test_light_falls_as_lambert_and_blinn_say():
    scene = replace(ball(), lights=(Light("head", (0.5,) * 3, (0.1,) * 3, (0.2,) * 3),))
    middle = np.asarray(render(scene, *ORIGIN, size=201))[100, 100]
    # Light, sight and normal all along one line: everything counts in full.
    expected = 255 * (np.array([0.8, 0.4, 0.2]) * (0.1 + 0.5) + 0.5 * 0.2)
    np.testing.assert_allclose(middle, expected, atol=0.51)

    above = Light("directional", (0.6,) * 3, direction=(0.0, 3.0, -3.0))
    matt = replace(scene.geometries[0], specular=0.0)
    image = np.asarray(render(replace(scene, geometries=(matt,), lights=(above,)), *ORIGIN, 201))
    np.testing.assert_allclose(
        image[100, 100], 255 * np.array([0.8, 0.4, 0.2]) * 0.6 / np.sqrt(2), atol=0.51
    )
    lowest = np.flatnonzero((image[:, 100] != 255).any(-1))[-1]
    assert not image[lowest, 100].any(), "the side away from the light is black"


@pytest.mark.parametrize("inside", [True, False])
def test_a_spot_lights_only_its_cone(inside):
    floor = Geometry("plane", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), specular=0.0)
    spot = Light("spot", (1.0,) * 3, position=(0.0, 0.0, 2.0), cutoff=30.0, exponent=4.0)
    # Straight down on a place in the cone, whose edge is at 2 m / sqrt(3), or out of it.
    across = 1.0 if inside else 1.3
    camera = Camera(target=(across, 0.0, 0.0), elevation=-90.0)
    scene = Scene((floor,), camera, (spot,))
    cosine = 2 / np.hypot(2, across)
    middle = np.asarray(render(scene, jnp.zeros((0, 3)), jnp.zeros((0, 4)), 65))[32, 32]
    np.testing.assert_allclose(middle, 255 * cosine**5 * inside, atol=0.6)


def test_a_checker_far_away_is_the_mean_of_its_colours():
    squares = Checker(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0.5, 0.5))
    floor = Geometry("plane", (0.0,) * 3, (1.0,) * 3, specular=0.0, checker=squares)
    camera = Camera(target=(0.25, 0.25, 0.0), elevation=-90.0, distance=0.2)
    scene = Scene((floor,), camera, (DAYLIGHT,))
    nothing = jnp.zeros((0, 3)), jnp.zeros((0, 4))
    near = np.asarray(render(scene, *nothing, 16))
    assert (near == [255, 0, 0]).all(), "one field fills the picture"
    other = replace(scene, camera=replace(camera, target=(0.75, 0.25, 0.0)))
    assert (np.asarray(render(other, *nothing, 16)) == [0, 0, 255]).all()
    far = replace(scene, camera=replace(camera, distance=400.0, far=1e3))
    np.testing.assert_allclose(
        render(far, *nothing, 16), np.broadcast_to([128, 0, 128], (16, 16, 3)), atol=1
    )


# Laws


def test_many_pictures_at_once_are_those_alone_and_eager_ones_those_of_a_program(mujoco):
    model, data = everything(mujoco)
    scene, (places, turns) = scene_of(model), poses(data)
    moved = places + np.random.default_rng(0).normal(size=(5, *places.shape)) / 5

    def image(places):
        return render(scene, places, turns, size=32)

    together = np.asarray(jax.jit(jax.vmap(jax.vmap(image)))(moved[None]))[0]
    alone = np.array([image(places) for places in moved])
    assert psnr(together, alone).min() > 50
    assert psnr(alone[0], alone[1]) < 35
    # A ball alone, for each operation is compiled by itself here.
    with jax.disable_jit():
        eager = render(ball(), *ORIGIN, size=16)
    assert psnr(eager, render(ball(), *ORIGIN, size=16)) > 50
    assert len(np.unique(eager)) > 5, "a shaded one"


def test_quaternions_of_any_length_turn_alike(mujoco):
    model, data = everything(mujoco)
    scene, (places, turns) = scene_of(model), poses(data)
    one, other = (render(scene, places, x, size=32) for x in (turns, -3.5 * turns))
    assert psnr(one, other) > 50


def test_supersampled_pictures_are_the_means_of_larger_ones():
    large = np.asarray(render(ball(), *ORIGIN, size=30)).astype(int)
    blocks = large.reshape(10, 3, 10, 3, 3).sum((1, 3))
    small = render(ball(), *ORIGIN, size=10, supersample=3)
    assert len(np.unique(blocks)) > 10, "a shaded ball"
    np.testing.assert_array_equal(small, (blocks + 4) // 9)


@pytest.mark.parametrize("axis", range(3))
def test_a_camera_that_follows_sees_no_motion(axis):
    away = 0.25 * np.eye(3, dtype=np.float32)[[axis]], ORIGIN[1]
    follows = tuple(k == axis for k in range(3))
    for camera, same in [(Camera(follows=follows), True), (Camera(), False)]:
        scene = replace(ball(), camera=camera)
        still, moved = (np.asarray(render(scene, *x, size=33)) for x in (ORIGIN, away))
        assert (still == moved).all() == same


def test_nothing_is_seen_before_near_and_beyond_far():
    """The ball's front is 1.5 m away."""
    for camera, seen in [
        ({"near": 1.4}, 1),
        ({"near": 1.95}, 0),
        ({"far": 1.6}, 1),
        ({"far": 1.4}, 0),
    ]:
        assert (np.asarray(render(ball(**camera), *ORIGIN, size=16)) != 255).any() == seen


# Likeness


@pytest.mark.parametrize(
    "floor",
    [
        dict(repeat="3 4", size="3 2 1"),
        dict(repeat="3.3 4.6", uniform="true", size="3 2 1"),
        dict(repeat="2 2", uniform="true", size="0 0 1"),
        dict(repeat="4 2", size="0 0 1"),
    ],
    ids=str,
)
def test_a_model_looks_as_mujoco_draws_it(mujoco, drawing, floor):
    model, data = everything(mujoco, **floor)
    renderer = mujoco.Renderer(model, 96, 96)
    for flag in ("SHADOW", "REFLECTION", "HAZE"):
        renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
    renderer.update_scene(data, -1)
    expected = renderer.render()
    renderer.close()
    likeness = psnr(render(scene_of(model), *poses(data), size=96), expected)
    assert likeness > 28, likeness


@pytest.mark.parametrize("title", TITLES)
def test_tasks_look_as_mujoco_draws_them(mujoco, drawing, title):
    """Along the tasks' random motions: 30 states from rest on, in MuJoCo's own physics."""
    brax_physics = pytest.importorskip("envs.brax_physics")
    mjcf = pytest.importorskip("brax.io.mjcf")
    from envs.brax_models import model_xml

    model = mujoco.MjModel.from_xml_string(mjcf.fuse_bodies(model_xml(title)))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    if "Pendulum" in title:
        data.qpos[1] = np.pi
    states = []
    for _ in range(30):
        data.ctrl[:] = 0.3 * rng.uniform(-1, 1, model.nu)
        for _ in range(20):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        states.append((data.qpos.copy(), *poses(data)))
    joints, places, turns = (np.array(x) for x in zip(*states, strict=True))
    expected = np.array([drawing.pictures(title, 64).draw(q) for q in joints])
    scene = brax_physics.task_scene(title)
    shown = [render(scene, *pose, size=64) for pose in zip(places, turns, strict=True)]
    likeness = psnr(shown, expected)
    assert len(np.unique(expected, axis=0)) > 20, "it moves"
    assert likeness.mean() > LIKENESS[title] and likeness.min() > 26, likeness


class Placed(NamedTuple):
    """What of Brax's states is drawn."""

    q: jax.Array
    qd: jax.Array
    x: Any


def test_a_start_of_the_ant_is_drawn_with_a_whole_body(drawing, monkeypatch):
    """Brax starts it with a quaternion that is not of length 1, which MuJoCo takes for a turn."""
    brax_physics = pytest.importorskip("envs.brax_physics")
    kinematics = pytest.importorskip("brax.kinematics")
    physics = brax_physics.physics_of("Ant", "generalized")

    def placed(q, qd):
        return Placed(q, qd, kinematics.forward(physics.env.sys, q, qd)[0])

    # All else that the engine makes of a start takes seconds to compile.
    monkeypatch.setattr(physics.env, "pipeline_init", placed)

    @jax.jit
    def start(key):
        state = physics.start(key)
        return state.q, physics.poses(state)

    joints, places = jax.device_get(start(jax.random.key(0)))
    image = render(brax_physics.task_scene("Ant"), *places, size=64)
    assert abs(np.linalg.norm(joints[3:7]) - 1) > 0.01
    assert psnr(image, drawing.pictures("Ant", 64).draw(joints)) > 28


# Errors


@pytest.mark.parametrize("size", [7, 0, -3, 32.0, True, "64", None], ids=str)
def test_sizes_that_make_no_picture_are_refused(size):
    with pytest.raises(ValueError, match="expected a whole number of at least 8"):
        render(ball(), *ORIGIN, size=size)


@pytest.mark.parametrize("supersample", [0, 1.5, True], ids=str)
def test_supersampling_takes_whole_numbers(supersample):
    with pytest.raises(ValueError, match=f"got supersample={supersample}, expected a whole"):
        render(ball(), *ORIGIN, supersample=supersample)


@pytest.mark.parametrize("shapes", [((1, 3), (1, 3)), ((0, 3), (0, 4)), ((3,), (4,))], ids=str)
def test_poses_that_do_not_fit_the_scene_are_refused(shapes):
    with pytest.raises(ValueError, match=r"expected \[L, 3\] and \[L, 4\] of at least 1 links"):
        render(ball(), *map(jnp.zeros, shapes))


def test_what_cannot_be_drawn_is_named(mujoco):
    model, _ = everything(mujoco)
    assert len(scene_of(model).geometries) == 6, "the mesh's group is not drawn"
    model.geom_group[:] = 0
    with pytest.raises(NotImplementedError, match="mesh 'number 6' of the body 'd'.*plane, sph"):
        scene_of(model)
    with pytest.raises(ValueError, match="without geometries"):
        scene_of(mujoco.MjModel.from_xml_string("<mujoco/>"))
    with pytest.raises(ValueError, match="got dict, expected a mujoco.MjModel, or a brax.System"):
        scene_of({})
    with pytest.raises(ValueError, match="cannot draw a 'mesh', expected one of plane, sphere"):
        Geometry("mesh", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="only planes have checkers, not a box"):
        Geometry("box", (1.0,) * 3, (1.0,) * 3, checker=Checker(((0.0,) * 3,) * 2, (1.0, 1.0)))


def test_a_system_of_brax_is_its_models_scene():
    mjcf = pytest.importorskip("brax.io.mjcf")
    from envs.brax_models import model_xml

    system = mjcf.loads(model_xml("Hopper"))
    assert len(scene_of(system).geometries) == 5
    assert scene_of(system) == scene_of(system.mj_model)
    with pytest.raises(ValueError, match="got NoneType, expected a mujoco.MjModel"):
        scene_of(system.replace(mj_model=None))
