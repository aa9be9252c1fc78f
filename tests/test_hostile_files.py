"""Files of every kind that is read: damaged, or with a header that claims what is not there."""

import dataclasses
import functools
import io
import struct
import time
import zipfile

import numpy as np
import pytest
import trimesh
from numpy.lib import format as npy

import approxjac as aj
from approxjac.errors import ApproxJacError, TrajectoryFileError
from approxjac.realtime import SimulatedDriver
from approxjac.realtime.control import RobotRun
from approxjac.robots.meshes import find_mesh
from approxjac.view.look import load_mesh

ARRAYS = ("t", "q", "v", "x", "x_d", "error", "command", "tau", "state", "status", "slack", "V")


@functools.cache
def made():
    """A run of an arm that learns gravity, and one on a robot."""
    arm = aj.load_robot("two_link")
    task, q = aj.PositionTask(arm, axes="xz"), np.array([0.6, 1.2])
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(arm))
    plant = aj.Plant(arm, task)
    run = aj.simulate(plant, law, task.value(q) + 0.05, q, duration=0.05)
    limited = aj.TorqueLimited(law, aj.Limits(effort=100.0))
    driver = SimulatedDriver(plant, q, pace=np.inf)
    return run, aj.control(driver, limited, task.value(q) + 0.01, duration=0.05)


# -- how a file of each kind is written, read, and what tells whether it is the same ----------


def write_run(path):
    made()[0].save(path)


def write_robot_run(path):
    made()[1].save(path)


def of_run(path, kind=aj.Trajectory):
    run = kind.load(path)
    str(run)
    return [getattr(run, name) for name in ARRAYS] + [run.robot_name, run.joint_names]


def of_robot_run(path):
    return of_run(path, RobotRun)


def write_urdf(path):
    aj.load_robot("two_link").with_object(0.2, 0.5).save_urdf(path)


def of_urdf(path):
    arm = aj.load_robot(path)
    return [
        arm.urdf,
        arm.joint_names,
        aj.PositionTask(arm, arm.frame_names[-1]).value(arm.neutral()),
    ]


def write_scenario(path):
    path.write_text(
        'robot = "panda"\n[true]\nobject = { length = 0.2, mass = 0.5, axis = "x" }\n'
        'shifts = { panda_joint4 = [0.0, 0.01, 0.0] }\n[controller]\ngravity = "learnt"\n'
        "[run]\nstart = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]\nduration = 2.5\n"
    )


def of_scenario(path):
    return [str(aj.Scenario.load(path))]


def write_mesh(path):
    path.write_bytes(encoded(trimesh.creation.icosphere(1), path.suffix[1:]))


def encoded(mesh, kind):
    found = mesh.export(file_type=kind)
    return found.encode() if isinstance(found, str) else found


def of_mesh(path):
    try:
        mesh = load_mesh(path)
    except ValueError as error:  # which the drawing of a robot tells, and draws a capsule instead
        if not str(error).startswith(("cannot be read: ", "holds ")):
            raise
        raise ApproxJacError(str(error)) from error
    return [mesh.vertices, mesh.faces]


KINDS = {  # ending, what writes one, what reads it; whether the file tells that it is damaged
    "run": (".npz", write_run, of_run, True),
    "robot's run": (".npz", write_robot_run, of_robot_run, True),
    "URDF": (".urdf", write_urdf, of_urdf, False),
    "scenario": (".toml", write_scenario, of_scenario, False),
    "STL": (".stl", write_mesh, of_mesh, False),
    "OBJ": (".obj", write_mesh, of_mesh, False),
    "DAE": (".dae", write_mesh, of_mesh, False),
    "PLY": (".ply", write_mesh, of_mesh, False),
}  # fmt: skip


def damaged(data, rng):
    """Change, take away, put in or repeat a few bytes, or cut the file off."""
    data, i = bytearray(data), int(rng.integers(len(data)))
    n = int(rng.integers(1, 9))
    kind = rng.integers(6)
    if kind == 0:
        data[i] = int(rng.integers(256))
    elif kind == 1:
        data[i : i + n] = rng.bytes(n)
    elif kind == 2:
        del data[i : i + n]
    elif kind == 3:
        data[i:i] = rng.bytes(n)
    elif kind == 4:
        data[i:i] = data[i : i + 40]
    else:
        del data[i:]
    return bytes(data)


@pytest.mark.filterwarnings("ignore::approxjac.errors.ImplausibleRobotWarning")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [30, pytest.param(400, marks=pytest.mark.study)])
def test_damaged_files_are_named_errors_or_what_they_were(tmp_path, kind, count):
    """Of texts and meshes, which hold no checksum, something else may be read that is whole."""
    ending, write, read, is_checked = KINDS[kind]
    path = tmp_path / f"file{ending}"
    path = write(path) or path
    whole, rng = path.read_bytes(), np.random.default_rng(count)
    before, refused = read(path), 0
    for _ in range(count):
        path.write_bytes(damaged(whole, rng))
        try:
            after = read(path)
        except ApproxJacError as error:
            assert len(str(error)) > 15  # noqa: PT017
            refused += 1
            continue
        if is_checked:
            for ours, theirs in zip(after, before, strict=True):
                assert np.array_equal(ours, theirs, equal_nan=np.asarray(ours).dtype.kind == "f")
    assert refused > 0.05 * count
    path.write_bytes(whole)
    assert all(np.array_equal(*pair) for pair in zip(read(path)[:2], before[:2], strict=True))


# -- runs that claim more than they hold ------------------------------------------------------


def rewritten(path, changes, **options):
    """Write the run with other members in its archive: bytes by their names."""
    made()[0].save(path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()} | changes
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def header(shape, dtype):
    stream = io.BytesIO()
    described = {"descr": dtype, "fortran_order": False, "shape": shape}
    npy.write_array_header_1_0(stream, described)
    return stream.getvalue()


def saved(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


CLAIMS = {
    "a huge shape": ({"q.npy": header((10**12, 2), "<f8")}, "is not a trajectory"),
    "a negative shape": ({"q.npy": header((-1, 2), "<f8") + bytes(16)}, "is not a trajectory"),
    "huge texts": ({"texts.npy": header((), f"<U{10**8}")}, "is not a trajectory"),
    "objects": ({"q.npy": header((3, 2), "|O") + bytes(48)}, "is not a trajectory"),
    "float16": ({"q.npy": saved(np.zeros((51, 2), np.float16))}, "float64 or int64, got float16"),
    "long double": (
        {"v.npy": saved(np.zeros((51, 2), np.longdouble))}, "float64 or int64, got float128"
    ),
    "complex": ({"tau.npy": saved(np.zeros((51, 2), complex))}, "got complex128"),
    "a derived float16": ({"V.npy": saved(np.zeros(51, np.float16))}, "V must be numbers"),
    "no header": ({"q.npy": b"\x93NUMPY"}, "is not a trajectory"),
    "lists in lists": ({"texts.npy": saved(np.array("[" * 100_000))}, "is not a trajectory"),
}  # fmt: skip


@pytest.mark.parametrize("name", CLAIMS)
def test_runs_that_claim_what_is_not_there_are_refused_at_once(tmp_path, name):
    members, told = CLAIMS[name]
    rewritten(tmp_path / "run.npz", members)
    start = time.process_time()
    with pytest.raises(TrajectoryFileError, match=told):
        aj.Trajectory.load(tmp_path / "run.npz")
    assert time.process_time() - start < 1.0


def test_joints_have_units_that_are_known(tmp_path):
    run = dataclasses.replace(made()[0], joint_units=("rad", "furlong"))
    with pytest.raises(TrajectoryFileError, match="joints have other units than rad or m"):
        aj.Trajectory.load(run.save(tmp_path / "run"))


ODD = {
    "float16": lambda q: q.astype(np.float16),
    "float128": lambda q: q.astype(np.longdouble),
    "a masked array of float64": lambda q: np.ma.masked_array(q, q > 0.6),
    "list": lambda q: q.tolist(),
}


@pytest.mark.parametrize("name", ODD)
def test_a_run_holds_plain_numbers(name):
    run = made()[0]
    with pytest.raises(aj.InvalidInputError, match=f"must be an array of .*, got {name}$"):
        dataclasses.replace(run, q=ODD[name](run.q))


# -- meshes ---------------------------------------------------------------------------------


def ball(kind):
    return encoded(trimesh.creation.icosphere(1), kind)


def counting(count):
    """A binary STL whose header claims triangles."""
    data = bytearray(ball("stl"))
    data[80:84] = struct.pack("<I", count)
    return bytes(data)


def zipped():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.dae", bytes(50_000_000))
    return stream.getvalue()


def multiplied():
    """A COLLADA file with a ball 2³⁰ times."""
    text = ball("dae").decode()
    nodes = "".join(
        f'<node id="n{i}">{2 * f"""<instance_node url="#n{i + 1}"/>"""}</node>' for i in range(30)
    )
    return text.replace(
        "</library_geometries>", f"</library_geometries><library_nodes>{nodes}</library_nodes>"
    ).encode()


PLY = """ply
format {}
element vertex 4000000000
property float x
property float y
property float z
element face 4000000000
property list uchar int vertex_indices
end_header
0 0 0
"""
MESHES = {
    "triangles.stl": (lambda: counting(2**32 - 1), "holds no triangles"),
    "vertices.ply": (lambda: PLY.format("ascii 1.0").encode(), "cannot be read"),
    "binary.ply": (lambda: PLY.format("binary_little_endian 1.0").encode(), "cannot be read"),
    "index.obj": (lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4000000000\n", "cannot be read"),
    "digits.obj": (lambda: b"v " + b"1" * 10**6 + b" 0 0\nf 1 1 1\n", "holds no triangles"),
    "bomb.dae": (zipped, "it is an archive"),
    "bomb.3mf": (zipped, "one of stl, obj, dae, ply, off, not '.3mf'"),
    "bomb.zip": (zipped, "must be one of stl, obj, dae, ply, off, not '.zip'"),
    "copies.dae": (multiplied, "its nodes are copied"),
    "entities.dae": (
        lambda: ball("dae").replace(
            b"<COLLADA",
            b"<!DOCTYPE r [<!ENTITY a0 'aaaaaaaaaaaaaaaaaaaaaaaaa'>"
            + b"".join(b"<!ENTITY a%d '%s'>" % (i + 1, b"&a%d;" % i * 10) for i in range(9))
            + b"]><COLLADA",
        ).replace(b"</COLLADA>", b"&a9;</COLLADA>"),
        "cannot be read",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MESHES)
def test_meshes_that_claim_what_is_not_there_are_refused_at_once(tmp_path, name):
    make, told = MESHES[name]
    (tmp_path / name).write_bytes(make())
    start = time.process_time()
    with pytest.raises(ValueError, match=told):
        load_mesh(tmp_path / name)
    assert time.process_time() - start < 2.0


def test_a_mesh_file_that_is_too_long_is_not_read(tmp_path):
    with (tmp_path / "a.stl").open("wb") as file:
        file.truncate(1_000_000_000)
    with pytest.raises(ValueError, match="it has 1000000000 bytes, more than 200000000"):
        load_mesh(tmp_path / "a.stl")


@pytest.mark.parametrize("name", ["m" * 5000, "a/" * 3000 + "m.stl", "\ud800.stl", "a\0.stl"])
def test_mesh_names_that_no_file_can_have_are_not_found(tmp_path, name):
    for form in (name, f"package://{name}", f"file://{name}"):
        assert find_mesh(form, tmp_path) is None


def test_a_long_mesh_name_is_drawn_without_the_mesh(tmp_path):
    mesh = f'<visual><geometry><mesh filename="{"m" * 5000}.stl"/></geometry></visual>'
    urdf = aj.load_robot("two_link").urdf.replace(
        '<link name="link1">', f'<link name="link1">{mesh}'
    )
    arm = aj.load_robot(urdf)
    run = dataclasses.replace(made()[0], scene=dataclasses.replace(made()[0].scene, truth=arm))
    assert aj.view.save_page(run, tmp_path / "page.html").stat().st_size > 1000
    assert arm.save_urdf(tmp_path / "arm.urdf").is_file()


# -- texts ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "robot = 'panda'\n[run]\nduration = " + "1" * 5000,
        "robot = 'panda'\n[run]\nduration = " + "1" * 400,
        "robot = 'panda'\n" + "# x\n" * 500_000,
        "a" * 900_000,
    ],
)  # fmt: skip
def test_scenarios_that_nobody_wrote_are_refused_at_once(tmp_path, text):
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(aj.InvalidInputError):
        aj.Scenario.load(path)
    assert time.process_time() - start < 1.0
