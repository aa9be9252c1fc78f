"""Arms from recordings: drawn ones whose truth is known, and real ones where their files are."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.controllers.test_learnt_axes import Arm

import approxjac as aj
from approxjac import law
from approxjac.calibration import Recording, calibrate, next_configurations
from approxjac.calibration.calibrate import KINDS, USUAL_SD, _left_out
from approxjac.calibration.fit import TRACKER, Fit, Recorded
from approxjac.robots import KinematicRegressor
from approxjac.robots.kinematic_regressor import Unknowns

RECORDINGS = Path(__file__).parents[3] / "shared" / "recordings"
needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="recordings of real arms are not here: shared/recordings"
)
NOISE = 1e-4


def ball(arm, rng, place, noise=NOISE, rows=30):
    """Return configurations of a true arm with its tip at a place, but for noise."""
    found = []
    while len(found) < rows:
        q = np.array(
            pin.integrate(arm.believed.model, arm.q0, rng.uniform(-0.8, 0.8, arm.believed.nv))
        )
        aim = place + noise * rng.normal(size=3)
        for _ in range(30):
            off = arm.regressor.position(q, arm.theta) - aim
            J = arm.regressor.motion(q, 0.0 * arm.omega, arm.theta, 0.0 * arm.theta).J
            q = np.array(pin.integrate(arm.believed.model, q, -np.linalg.pinv(J) @ off))
        if np.linalg.norm(off) < 1e-9:
            found.append(arm.believed.angles(q))
    return np.array(found)


def sockets(arm, seed, places=3, **options):
    """Return recordings at some places, two sockets 5 cm apart at each."""
    rng, recordings = np.random.default_rng(seed), []
    for i in range(places):
        q = pin.integrate(arm.believed.model, arm.q0, rng.uniform(-0.6, 0.6, arm.believed.nv))
        at = arm.regressor.position(np.array(q), arm.theta)
        for name, shift in (("a", 0.0), ("b", 0.05)):
            q = ball(arm, rng, at + [shift, 0.0, 0.0], **options)
            recordings.append(Recording(q, socket=name, place=f"place {i}"))
    return recordings, {(f"place {i} a", f"place {i} b"): 0.05 for i in range(places)}


def elsewhere(arm, robot, count=100):
    """Return the median error of the tip [m], wherever the base is, and however it turns."""
    rng, task, model = np.random.default_rng(5), aj.PositionTask(robot), arm.believed.model
    ways = rng.uniform(-0.6, 0.6, (count, arm.believed.nv))
    q = [np.array(pin.integrate(model, arm.q0, way)) for way in ways]
    p = np.array([task.value(each) for each in q])
    x = np.array([arm.place(each) for each in q])
    p, x = p - p.mean(axis=0), x - x.mean(axis=0)
    R = law.nearest_rotation(x.T @ p)  # a socket tells neither
    return np.median(np.linalg.norm(p @ R.T - x, axis=1))


@pytest.fixture(scope="module")
def true_arm():
    return Arm("panda", 71)


@pytest.fixture(scope="module")
def recorded(true_arm):
    return sockets(true_arm, 1)


def test_sockets_tell_the_arm_where_they_are_not(true_arm, recorded):
    recordings, apart = recorded
    found = calibrate(true_arm.believed, recordings, apart=apart)
    assert found.is_better
    assert found.is_explained
    assert found.outliers == ()
    assert found.held_out < 4.0 * NOISE
    assert found.noise[0] == pytest.approx(NOISE, rel=0.3)
    drawing = calibrate(true_arm.believed, recordings, unknown=("tool",), apart=apart)
    assert elsewhere(true_arm, found.robot) < 0.5e-3
    assert elsewhere(true_arm, found.robot) < 0.15 * elsewhere(true_arm, drawing.robot)
    of_tool = [found.names.index(f"tool.{axis}") for axis in "xyz"]
    off = found.learnt[of_tool] - true_arm.theta[true_arm.tool]
    assert off @ np.linalg.solve(found.covariance[np.ix_(of_tool, of_tool)], off) < 16.3  # 99.9 %


def test_what_is_said_is_what_was_found(true_arm, recorded):
    recordings, apart = recorded
    found = calibrate(true_arm.believed, recordings, apart=apart)
    text = str(found)
    assert text.startswith(f"panda: {1e3 * found.held_out:.2f} mm are left where it was not fitted")
    for name, sd in zip(found.names, found.sd, strict=True):
        assert name in text
        assert f"{1e3 * sd:.2f} m" in text
    assert [each.samples for each in found.places] == [60, 60, 60]


@pytest.mark.study
def test_a_bad_row_and_a_bad_place_harm_little(true_arm, recorded):
    recordings, apart = recorded
    usual = elsewhere(true_arm, calibrate(true_arm.believed, recordings, apart=apart).robot)
    q = recordings[0].q.copy()
    q[3, 2] += 0.05
    bad = [Recording(q, socket="a", place="place 0"), *recordings[1:]]
    found = calibrate(true_arm.believed, bad, apart=apart)
    assert found.outliers == ("place 0 a row 4",)
    assert elsewhere(true_arm, found.robot) < 1.2 * usual
    loose, _ = sockets(true_arm, 2, places=1, noise=2e-3)
    moved = [Recording(each.q, socket=each.socket, place="loose") for each in loose]
    found = calibrate(true_arm.believed, [*recordings, *moved], apart=apart)
    assert max(found.places, key=lambda each: each.left).place == "loose"
    assert elsewhere(true_arm, found.robot) < 1.5 * usual


def test_of_an_arm_as_drawn_little_is_changed():
    arm = Arm("ur5", 72)
    arm.theta[:] = arm.regressor.theta
    recordings, apart = sockets(arm, 3, places=2)
    found = calibrate(arm.believed, recordings, apart=apart)
    assert found.scale == 0.1
    assert (
        found.held_out < 1.05 * np.mean([each.drawing for each in found.places])
        or not found.is_better
    )
    assert elsewhere(arm, found.robot) < 0.1e-3
    # no socket tells where the base is, however little drawings are believed to be wrong
    first = [found.names.index(f"{arm.believed.joint_names[0]}.{axis}") for axis in "xyz"]
    assert (found.share[first] < 0.05).all()
    # its numbers are those of the robot, also where that has its tool only
    regressor = KinematicRegressor(found.robot, axes=True)
    mean, _ = found.about(regressor, found.names)
    assert_allclose(mean, regressor.theta, atol=1e-12)
    off = found.learnt - arm.theta
    assert off @ np.linalg.solve(found.covariance, off) < 72.1  # 99.9 % of χ² of 39


def test_what_is_said_of_an_arm_with_its_tool_only_does_not_exclude_the_best_fit():
    """It is as far off as it differs from that besides: xᵀ(P + xxᵀ)⁻¹x < 1, for any x."""
    arm = Arm("ur5", 72)
    arm.theta[:] = arm.regressor.theta
    recordings, apart = sockets(arm, 3, places=2)
    found = calibrate(arm.believed, recordings, apart=apart)
    assert not found.is_better
    unknowns = Unknowns(KinematicRegressor(arm.believed, axes=True), found.kinds, USUAL_SD)
    samples = Recorded.of([each.of(arm.believed) for each in recordings])
    best = Fit(unknowns, samples, apart, found.scale).solved()
    off = best.u - found.learnt
    assert off @ np.linalg.solve(best.P, off) > 2.0
    assert off @ np.linalg.solve(found.covariance, off) < 1.0


def test_of_few_rows_a_tool_is_known_as_their_noise_tells():
    """The covariance of least squares, with the noise of so many rows less the six fitted."""
    arm = Arm("panda", 71)
    tool, arm.theta[:] = arm.theta[arm.tool].copy(), arm.regressor.theta
    arm.theta[arm.tool] = tool
    at, rng = arm.regressor.position(arm.q0, arm.theta), np.random.default_rng(8)
    ratios, sizes = [], []
    for _ in range(4):
        q = ball(arm, rng, at, rows=10)
        found = calibrate(arm.believed, Recording(q, socket="a", place="b"), unknown=("tool",))
        H = np.array([arm.regressor.linear(each, arm.theta)[0][:, arm.tool] for each in q])
        H = H - H.mean(axis=0)
        P = found.noise[0] ** 2 * np.linalg.inv(np.einsum("kij,kil->jl", H, H))
        ratios.append(found.sd / np.sqrt(P.diagonal()))
        sizes.append(found.noise[0])
    assert (np.array(ratios) > 1.0).all()  # as rows weigh a little less than one each
    assert np.median(ratios) < 1.1
    assert_allclose(np.mean(sizes), NOISE, rtol=0.2)


def test_backlash_is_not_explained(true_arm):
    rng = np.random.default_rng(4)
    recordings, apart = sockets(true_arm, 4, places=2)
    rattled = [
        Recording(
            each.q + 6e-3 * rng.choice([-1.0, 1.0], each.q.shape),
            socket=each.socket,
            place=each.place,
        )
        for each in recordings
    ]
    found = calibrate(true_arm.believed, rattled, apart=apart)
    assert not found.is_explained
    assert "not explained" in str(found)


@pytest.mark.parametrize("turn", [0.0, 2.5])
@pytest.mark.parametrize("poses", [False, True])
def test_a_tracker_anywhere_tells_the_arm(turn, poses):
    arm, rng = Arm("kinova", 73, turn), np.random.default_rng(6)
    q = [
        np.array(pin.integrate(arm.believed.model, arm.q0, rng.uniform(-0.8, 0.8, 6)))
        for _ in range(60)
    ]
    x = np.array([arm.place(each) for each in q]) + NOISE * rng.normal(size=(60, 3))
    turns = None
    if poses:
        off = [law.rotation_exp(5e-4 * rng.normal(size=3)) for _ in q]
        turns = np.array(
            [pin.Quaternion(d @ arm.turned(each)).coeffs() for d, each in zip(off, q, strict=True)]
        )
    angles = np.array([arm.believed.angles(each) for each in q])
    found = calibrate(arm.believed, Recording(angles, x=x, quaternion=turns, place="room"))
    assert len(found.places) == 5
    assert found.held_out < 4.0 * NOISE
    assert elsewhere(arm, found.robot) < 0.3e-3
    if poses:  # how the tip turns, whatever the tracker's axes are
        task, some = aj.PoseTask(found.robot), q[:20]
        ours = [pin.Quaternion(task.value(each)[3:]).matrix() for each in some]
        R = law.nearest_rotation(
            sum(arm.turned(q) @ R_q.T for q, R_q in zip(some, ours, strict=True))
        )
        off = [
            np.linalg.norm(pin.log3(R @ R_q @ arm.turned(q).T))
            for q, R_q in zip(some, ours, strict=True)
        ]
        assert np.median(off) < 1e-3


def test_chosen_configurations_tell_more_than_random_ones(true_arm):
    sd = {}
    rng, n = np.random.default_rng(7), 10
    every = [true_arm.q(t) for t in np.linspace(2.0, 40.0, 200)]
    chosen = next_configurations(true_arm.believed, None, n, every)
    random = np.array([every[i] for i in rng.choice(200, n, replace=False)])
    assert len(np.unique(chosen, axis=0)) == n
    for name, q in (("chosen", chosen), ("random", random)):
        x = np.array([true_arm.place(each) for each in q])
        found = calibrate(true_arm.believed, Recording(q, x=x, place="room"))
        sd[name] = np.log(np.linalg.eigvalsh(found.covariance)).sum()
    assert sd["chosen"] < sd["random"] - 3.0
    told = calibrate(true_arm.believed, Recording(chosen, x=x, place="room"))
    assert next_configurations(true_arm.believed, told, 3, every).shape == (3, 7)


def test_what_a_tracker_leaves_has_the_derivatives_of_its_differences(rng):
    """By the arm's numbers, and by how the tracker and the tool are turned, which is by far."""
    arm = aj.load_robot("so101")
    unknowns = Unknowns(KinematicRegressor(arm, axes=True), ("tool", "axes"), USUAL_SD)
    R, T = (law.rotation_exp(rng.normal(size=3)) for _ in range(2))
    rows = []
    for q in arm.configurations(6):
        H, o = unknowns.at(q, unknowns.u)
        turn = R @ unknowns.turn(q, unknowns.u).R @ T
        x = R @ (o + H @ unknowns.u) + [0.3, -2.0, 1.0]
        rows.append((q, x, turn, TRACKER, "room", "row"))
    samples = Recorded(*map(np.array, zip(*rows, strict=True)))

    def left(step):
        fit = Fit(unknowns, samples, {}, 1.0)
        fit._place()
        fit._move(step)
        return fit._residuals()

    size = len(unknowns.u) + 9
    none, J = left(np.zeros(size))
    assert_allclose(none, 0.0, atol=1e-9)
    for unit, slope in zip(np.eye(size), np.moveaxis(J, 2, 0), strict=True):
        more, less = (left(step * unit)[0] for step in (1e-5, -1e-5))
        assert_allclose((more - less) / 2e-5, slope, atol=1e-6)


@pytest.mark.parametrize("is_known", [False, True])
def test_each_configuration_is_the_one_that_adds_most_information(is_known, rng):
    """By the matrix of information, which sums up what is measured, in place of its inverse."""
    arm = aj.load_robot("so101")
    q = np.array([*arm.configurations(60)])
    unknowns = Unknowns(KinematicRegressor(arm, axes=True), KINDS, USUAL_SD)
    u, P, known = unknowns.u, np.diag(unknowns.sd**2), None
    if is_known:  # some of it well, and some together only
        u, mixed = u + 1e-3, np.linalg.qr(rng.normal(size=P.shape))[0]
        P = mixed @ np.diag(np.geomspace(1e-8, 1e-2, len(P))) @ mixed.T
        known = SimpleNamespace(kinds=KINDS, names=tuple(unknowns.names), covariance=P, learnt=u)
    H = [np.hstack([unknowns.at(each, u)[0], np.eye(3)]) / 2e-4 for each in q]
    before, chosen = np.eye(len(P) + 3), []
    before[: len(P), : len(P)] = np.linalg.inv(P)
    for _ in range(7):
        adds = [np.linalg.slogdet(before + each.T @ each)[1] for each in H]
        chosen.append(max(set(range(60)) - set(chosen), key=adds.__getitem__))
        before = before + H[chosen[-1]].T @ H[chosen[-1]]
    found = next_configurations(arm, known, 7, q)
    np.testing.assert_array_equal(found, q[chosen])


@pytest.mark.parametrize("wrong", [0.054, 0.06])
def test_a_wrong_distance_is_not_believed(true_arm, recorded, wrong):
    """It makes the arm another one, which no spread within a socket shows."""
    recordings, apart = recorded
    found = calibrate(true_arm.believed, recordings, apart=dict.fromkeys(apart, wrong))
    assert not found.is_explained
    assert "known distances" in found.verdict


@pytest.mark.study
def test_a_wrong_order_of_quaternions_is_not_believed():
    arm = Arm("ur5", 74, 1.0)
    q = [np.array(pin.integrate(arm.believed.model, arm.q0, 0.1 * k * np.cos(np.arange(6.0) * k)))
         for k in range(30)]  # fmt: skip
    x = np.array([arm.place(each) for each in q])
    turns = np.array([pin.Quaternion(arm.turned(each)).coeffs() for each in q])
    assert calibrate(arm.believed, Recording(np.array(q), x=x, quaternion=turns)).is_explained
    for other in (turns[:, [3, 0, 1, 2]], turns * [-1.0, -1.0, -1.0, 1.0]):
        found = calibrate(arm.believed, Recording(np.array(q), x=x, quaternion=other))
        assert not found.is_explained


def test_sockets_and_a_tracker_do_not_judge_each_other(true_arm, recorded):
    recordings, apart = recorded
    q = np.array([true_arm.q(t) for t in np.linspace(2.0, 30.0, 30)])
    x = np.array([true_arm.place(each) for each in q]) + [1.0, 0.0, 0.0]
    found = calibrate(
        true_arm.believed, [*recordings, Recording(q, x=x, place="cell")], apart=apart
    )
    assert found.is_explained
    assert found.held_out < 4.0 * NOISE
    (cell,) = (each for each in found.places if each.place == "cell")
    assert np.isnan(cell.held_out)


def test_what_makes_no_sense_is_refused(true_arm, recorded, tmp_path):
    arm, (recordings, _) = true_arm.believed, recorded
    for q, count in ((recordings[0].q[:4], 4), (np.tile(recordings[0].q[:2], (20, 1)), 2)):
        with pytest.raises(aj.InvalidInputError, match=f"10 different postures, got {count}"):
            calibrate(arm, Recording(q))
    with pytest.raises(
        aj.InvalidInputError, match=r"apart must name sockets, place 0 a, .*, got x"
    ):
        calibrate(arm, recordings, apart={("x", "place 0 a"): 0.05})
    with pytest.raises(aj.InvalidInputError, match=r"must have 6 joints of ur5, got 7"):
        calibrate(aj.load_robot("ur5"), recordings)
    with pytest.raises(aj.InvalidInputError, match="quaternion needs x"):
        Recording(np.zeros((3, 7)), quaternion=np.zeros((3, 4)))
    with pytest.raises(aj.InvalidInputError, match="socket must be one name or one for each of 3"):
        Recording(np.zeros((3, 7)), socket=["a", "b"])
    with pytest.raises(aj.InvalidInputError, match="at least 16 configurations, got 2"):
        next_configurations(arm, candidates=[arm.neutral()] * 2)
    path = tmp_path / "log.csv"
    path.write_text("1,2\n1,2,3\n")
    with pytest.raises(aj.InvalidInputError, match="rows of equal length"):
        Recording.load(path)
    path.write_text("1,2\n1,a\n")
    with pytest.raises(aj.InvalidInputError, match="must hold numbers"):
        Recording.load(path)
    with pytest.raises(aj.InvalidInputError, match="cannot be read"):
        Recording.load(tmp_path / "none.csv")
    path.write_text("a,x\n1,2\n1,-\n")
    with pytest.raises(aj.InvalidInputError, match=r"log.csv .*: column x, row 2 must hold .*'-'"):
        Recording.load(path)
    twice = [recordings[0], recordings[0]]
    with pytest.raises(aj.InvalidInputError, match="one socket each, got two of 'place 0 a'"):
        calibrate(arm, twice)
    with pytest.raises(aj.InvalidInputError, match="apart must be a mapping"):
        calibrate(arm, recordings, apart=0.05)
    with pytest.raises(aj.InvalidInputError, match="apart must be"):
        calibrate(arm, recordings, apart={("place 0 a", "place 0 b"): 50.0})
    with pytest.raises(aj.InvalidInputError, match="quaternion of a recording must not be zero"):
        Recording(np.zeros((3, 7)), x=np.zeros((3, 3)), quaternion=np.zeros((3, 4)))


@pytest.mark.parametrize("name", ["tracker.csv", "log.csv"])
def test_a_file_beside_the_command_has_the_folder_as_its_place(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(name).write_text("\ufeffa; b\n1; 2\n3; 4\n", encoding="utf-8")
    read = Recording.load(name)
    assert (read.place[0], read.joints, read.kind) == (tmp_path.name, ("a", "b"), "socket")
    rows = np.array([np.full(7, 0.1 * k) for k in range(12)])
    Path(name).write_text("\n".join(",".join(map(str, row)) for row in rows))
    assert len(calibrate(aj.load_robot("panda"), Recording.load(name)).residuals) == 12


def test_a_file_is_read_by_its_columns(tmp_path):
    arm, path = aj.load_robot("ur5"), tmp_path / "table" / "log.csv"
    path.parent.mkdir()
    rows = np.random.default_rng(8).uniform(-1.0, 1.0, (4, 6))
    names = list(reversed(arm.joint_names))
    text = [",".join(["t", *names, "socket", "x", "y", "z", "note"])]
    text += [
        ",".join(["0", *map(repr, row.tolist()), s, "1", "2", "3", "ok"])
        for row, s in zip(rows, "abab", strict=True)
    ]
    path.write_text("\n".join(text))
    read = Recording.load(path)
    assert read.kind == "point"
    assert read.socket == ("a", "b", "a", "b")
    assert read.place == ("table",) * 4
    assert_allclose(read.of(arm).q, rows[:, ::-1])
    assert_allclose(read.x, np.tile([1.0, 2.0, 3.0], (4, 1)))
    path.write_text("\n".join(",".join(map(repr, row.tolist())) for row in rows))
    bare = Recording.load(path, socket="hole")
    assert (bare.kind, bare.socket[0], len(bare)) == ("socket", "hole", 4)
    assert_allclose(bare.of(arm).q, rows)
    with pytest.raises(aj.InvalidInputError, match="all joints of panda, got no panda_joint1"):
        read.of(aj.load_robot("panda"))


# -- real arms ------------------------------------------------------------------------------------


def real(name, without=()):
    """Return the recordings of a real arm, and the distances of its sockets."""
    files = sorted((RECORDINGS / "platonics" / name).glob("*/hole_*.csv"))
    recordings = [Recording.load(path) for path in files if path.parent.name not in without]
    places = {each.place[0] for each in recordings}
    return recordings, {(f"{place} hole_0", f"{place} hole_1"): 0.05 for place in places}


@needs_recordings
@pytest.mark.parametrize(
    ("name", "without", "most"),
    [("panda_2", ("high",), 0.40e-3), ("panda_3", (), 0.28e-3), ("panda_6", (), 0.35e-3)],
)
def test_real_pandas_are_known_at_places_left_out(panda, name, without, most):
    recordings, apart = real(name, without)
    found = calibrate(panda, recordings, apart=apart)
    assert found.held_out < most
    assert found.held_out < 0.1 * np.mean([each.drawing for each in found.places])


@pytest.mark.study
@needs_recordings
def test_a_bad_place_of_a_real_panda_harms_no_other(panda):
    recordings, apart = real("panda_2")
    found = calibrate(panda, recordings, apart=apart)
    held = {each.place: each.held_out for each in found.places}
    assert max(held, key=held.get) == "high"
    assert np.sqrt(np.mean([v**2 for k, v in held.items() if k != "high"])) < 0.40e-3


@pytest.mark.study
@needs_recordings
def test_a_calibration_holds_on_another_day(panda):
    """Of the same arm with another tool: only that is fitted anew."""
    recordings, apart = real("panda_2")
    robot = calibrate(panda, recordings, apart=apart).robot
    later, apart = real("panda_left")
    left = {
        name: np.sqrt(
            np.mean([each.left**2 for each in calibrate(arm, later, ("tool",), apart=apart).places])
        )
        for name, arm in (("learnt", robot), ("drawing", panda))
    }
    assert left["learnt"] < 0.35e-3
    assert left["drawing"] > 5e-3


@pytest.mark.study
@needs_recordings
@pytest.mark.parametrize("name", ["panda_3", "panda_6"])
def test_sixteen_chosen_configurations_of_a_real_panda_suffice(panda, name):
    recordings, apart = real(name)
    for place in {each.place[0] for each in recordings}:
        chosen = []
        for each in recordings:
            if each.place[0] == place:
                q = next_configurations(panda, None, 8, each.q)
                chosen.append(Recording(q, socket=each.socket[0], place=place))
        robot = calibrate(
            panda,
            chosen,
            apart=apart and {k: v for k, v in apart.items() if k[0].startswith(place)},
        ).robot
        others = [each for each in recordings if each.place[0] != place]
        kept = calibrate(robot, others, ("tool",))
        assert np.sqrt(np.mean([each.left**2 for each in kept.places])) < 0.45e-3


@needs_recordings
def test_a_good_drawing_is_not_made_worse_and_backlash_is_told():
    drawings = RECORDINGS / "platonics" / "urdf"
    iiwa = aj.load_robot(drawings / "iiwa14_epfl.urdf", tip="ball_link")
    recordings, apart = real("kuka_14")
    found = calibrate(iiwa, recordings, apart=apart)
    assert found.scale < 1.0
    for each in found.places:
        assert each.held_out <= 1.05 * each.drawing
    lite = aj.load_robot(drawings / "gen3lite.urdf", tip="ball_link")
    recordings, apart = real("dinova_2")
    found = calibrate(lite, recordings, apart=apart)
    assert not found.is_explained


@needs_recordings
def test_poses_of_a_real_camera_are_predicted(panda):
    rows = np.loadtxt(RECORDINGS / "philnad" / "fr3_camera_poses.csv", delimiter=",", comments="#")
    poses = rows[:, 7:].reshape(-1, 3, 4)
    turns = np.array([pin.Quaternion(pose[:, :3]).coeffs() for pose in poses])
    found = calibrate(
        panda, Recording(rows[:, :7], x=poses[..., 3], quaternion=turns, place="board")
    )
    assert found.held_out < 1.7e-3
    assert found.held_out < 0.45 * np.mean([each.drawing for each in found.places])


def test_the_distance_of_the_only_two_sockets_counts(true_arm):
    recordings, apart = sockets(true_arm, 9, places=1, rows=6)
    regressor = KinematicRegressor(true_arm.believed, axes=True)
    unknowns = Unknowns(regressor, KINDS, USUAL_SD)
    samples = Recorded.of([each.of(true_arm.believed) for each in recordings])
    (pair,) = apart
    for distance in (0.05, 0.07):
        fit = Fit(unknowns, samples, {pair: distance}, 1.0)
        fit.solved()
        one, other = (fit._c[name] for name in pair)
        assert np.linalg.norm(one - other) == pytest.approx(distance, abs=2e-4)


def test_of_one_place_a_motion_is_left_out_in_pieces_and_other_rows_in_turn(rng):
    """Neighbours in a motion are alike, and would tell what is left out."""
    walk = np.cumsum(0.01 + 0.01 * rng.random((60, 3)), axis=0)
    pieces, turns = np.repeat(range(5), 12), np.tile(range(5), 12)
    for q, expected in ((walk, pieces), (rng.permutation(walk), turns)):
        rest = None, None, *(np.array([name] * 60) for name in ("a", "room", "row"))
        parts = _left_out(Recorded(q, *rest)).values()
        assert_array_equal(np.array([*parts]), [expected == k for k in range(5)])


@pytest.mark.parametrize("mark", [",", ";"])
def test_a_file_of_one_row_is_one_configuration(mark, tmp_path):
    arm, q = aj.load_robot("two_link"), ["0.25", "-1.5"]
    path = tmp_path / "one.csv"
    for text in (mark.join(q), mark.join(("joint2", "joint1")) + "\n" + mark.join(reversed(q))):
        path.write_text(text, encoding="utf-8")
        assert Recording.load(path).of(arm).q.tolist() == [[0.25, -1.5]]
