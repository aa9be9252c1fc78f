"""Recordings as other programs write them, with the libraries that these use."""

import json
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.calibration import Recording

NAMES = ("b", "a")
Q = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.8]])
HEADER = """std_msgs/Header header
{}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{}"""
JOINTS = HEADER.format(
    "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort", ""
)
PART = "=" * 80 + "\nMSG: geometry_msgs/{}\n{}"
POINT = PART.format("Point", "float64 x\nfloat64 y\nfloat64 z\n")
TURN = PART.format("Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n")
POSE = PART.format("Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n")
TIP = HEADER.format("geometry_msgs/Point point", POINT)
TIPS = HEADER.format("geometry_msgs/Pose pose", POSE + POINT + TURN)


def joint_state(t, q, effort=(1.0, 2.0)):
    stamp = {"sec": int(t), "nanosec": round((t % 1) * 1e9)}
    state = {"name": list(NAMES), "position": list(q), "velocity": [], "effort": list(effort)}
    return {"header": {"stamp": stamp, "frame_id": ""}, **state}


def tip(t, x, quaternion=None):
    stamp = {"sec": int(t), "nanosec": round((t % 1) * 1e9)}
    place = dict(zip("xyz", x, strict=True))
    if quaternion is None:
        return {"header": {"stamp": stamp, "frame_id": ""}, "point": place}
    pose = {"position": place, "orientation": dict(zip("xyzw", quaternion, strict=True))}
    return {"header": {"stamp": stamp, "frame_id": ""}, "pose": pose}


def ros2(path, messages):
    writer = pytest.importorskip("mcap_ros2.writer").Writer(str(path))
    texts = {"JointState": JOINTS, "PointStamped": TIP, "PoseStamped": TIPS}
    schemas = {
        kind: writer.register_msgdef(f"a_msgs/msg/{kind}", text) for kind, text in texts.items()
    }
    for i, (topic, kind, message) in enumerate(messages):
        writer.write_message(topic, schemas[kind], message, log_time=i, publish_time=i)
    writer.finish()


def in_json(path, messages):
    writer = pytest.importorskip("mcap.writer").Writer(str(path))
    writer.start()
    channels = {}
    for i, (topic, kind, message) in enumerate(messages):
        if topic not in channels:
            schema = writer.register_schema(f"sensor_msgs/{kind}", "jsonschema", b"{}")
            channels[topic] = writer.register_channel(topic, "json", schema)
        writer.add_message(channels[topic], i, json.dumps(message).encode(), i)
    writer.finish()


@pytest.mark.parametrize("write", [ros2, in_json])
def test_joints_of_mcap_are_those_at_the_time_of_the_tip(write, tmp_path):
    path = tmp_path / "cell" / "log.mcap"
    path.parent.mkdir()
    states = [("/joints", "JointState", joint_state(10.0 + k, q)) for k, q in enumerate(Q)]
    turns = [(0.0, 0.0, 0.0, 1.0), (0.6, 0.0, 0.0, 0.8)]
    poses = [(10.5, (1.0, 2.0, 3.0)), (11.25, (4.0, 5.0, 6.0))]
    seen = [
        ("/tip", "PoseStamped", tip(*pose, turn)) for pose, turn in zip(poses, turns, strict=True)
    ]
    late = [("/tip", "PoseStamped", tip(12.5, (0.0, 0.0, 0.0), turns[0]))]  # the joints were off
    write(path, [*states, *seen, *late])
    read = Recording.load(path)
    assert (read.kind, read.joints, read.place[0]) == ("pose", NAMES, "cell")
    assert_allclose(read.q, [[0.2, 0.3], [0.35, 0.5]])
    assert_allclose(read.x, [pose[1] for pose in poses])
    assert_allclose(read.quaternion, turns)
    assert_allclose(read.t, [10.5, 11.25])
    assert_allclose(read.tau, [[1.0, 2.0]] * 2)
    points = [("/tip", "PointStamped", tip(*pose)) for pose in poses]
    write(path, [*states, *points])
    assert Recording.load(path).kind == "point"
    write(path, states)
    assert Recording.load(path).kind == "motion"
    assert_allclose(Recording.load(path).q, Q)
    silent = [("/j", "JointState", joint_state(1.0 + k, q, ())) for k, q in enumerate(Q)]
    write(path, silent)  # of a robot without torques
    assert (Recording.load(path).tau, Recording.load(path).kind) == (None, "socket")


def test_what_mcap_lacks_is_said(tmp_path):
    path = tmp_path / "log.mcap"
    in_json(path, [("/a", "PointStamped", tip(1.0, (0.0, 0.0, 0.0)))])
    with pytest.raises(aj.InvalidInputError, match=r"log.mcap cannot be read: .* 0 joints"):
        Recording.load(path)
    points = [(f"/{k}", "PointStamped", tip(1.0, (0.0, 0.0, 0.0))) for k in "ab"]
    in_json(path, [("/j", "JointState", joint_state(1.0, Q[0])), *points])
    with pytest.raises(aj.InvalidInputError, match="points or poses /a, /b"):
        Recording.load(path)
    path.write_bytes(b"no mcap")
    with pytest.raises(aj.InvalidInputError, match=r"log.mcap cannot be read: "):
        Recording.load(path)


@pytest.mark.parametrize("names", [["b.pos", "a.pos"], {"motors": ["b", "a"]}])
def test_states_of_lerobot_have_the_names_of_its_table(names, tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    columns = {"observation.state": Q.tolist(), "timestamp": [0.0, 0.1, 0.2], "x": [1.0, 2.0, 3.0]}
    columns |= {"task": ["pick"] * 3, "image": [{"bytes": b"1"}] * 3, "done": [False] * 3}
    columns |= {"y": [0.0] * 3, "z": [0.0] * 3, "place": ["here", "here", "there"]}
    parquet.write_table(pyarrow.table(columns), path)
    with pytest.raises(aj.InvalidInputError, match=r"cannot be read: there is no meta/info.json"):
        Recording.load(path)
    info = tmp_path / "meta" / "info.json"
    info.parent.mkdir()
    info.write_text(json.dumps({"features": {"observation.state": {"names": names}}}))
    read = Recording.load(path)
    at = [read.joints.index(name) for name in NAMES]
    assert_allclose(read.q[:, at], Q)
    assert_allclose(read.x[:, 0], [1.0, 2.0, 3.0])
    assert_allclose(read.t, [0.0, 0.1, 0.2])
    assert read.place == ("here", "here", "there")
    path.write_bytes(b"no parquet")
    with pytest.raises(aj.InvalidInputError, match=r"file-000.parquet cannot be read: "):
        Recording.load(path)


@pytest.mark.parametrize(
    ("ending", "package"), [("mcap", "mcap.reader"), ("parquet", "pyarrow.parquet")]
)
def test_the_extra_that_is_missing_is_named(ending, package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    extra = {"mcap": "ros2", "parquet": "lerobot"}[ending]
    with pytest.raises(aj.errors.MissingPackageError, match=rf"pip install 'approxjac\[{extra}\]'"):
        Recording.load(tmp_path / f"log.{ending}")


def test_a_run_of_ours_is_a_recording(tmp_path):
    arm = aj.load_robot("ur5")
    task, plant = aj.PositionTask(arm), aj.Plant(arm, sensing=aj.Sensing(x_rate=50.0))
    q0 = plant.ready_configuration()
    run = aj.simulate(plant, aj.SetpointController(task), task.value(q0) + 0.05, q0, 0.5, dt=4e-3)
    read = Recording.load(run.save(tmp_path / "run"))
    assert (read.kind, len(read)) == ("point", 26)
    assert_allclose(read.of(arm).q[:5], [run.q[np.abs(run.t - t).argmin()] for t in read.t[:5]])
    row = run.t.searchsorted(read.t[7] - 1e-9)
    assert_allclose(read.x[7], run.x_measured[row])
    assert_allclose(read.tau[7], run.tau[row])
    planar = aj.PositionTask(arm, axes="xz")
    plant = aj.Plant(arm, planar)
    run = aj.simulate(plant, aj.SetpointController(planar), planar.value(q0), q0, 0.02, dt=4e-3)
    with pytest.raises(aj.InvalidInputError, match=r"run.npz cannot be read: its task is x, z"):
        Recording.load(run.save(tmp_path / "run"))
