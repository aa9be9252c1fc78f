"""A Panda brings a tag to its target in an image: pixels in, torques out.

You will see: images of a tag on a tool whose 15 cm the controller does not know, with the lens,
blur and noise of a camera that it believes turned by 20 degrees and 16 cm from where it stands.
OpenCV finds the corners, 30 times a second and 40 ms late. They end within 1.5 px of their targets.

You will learn: what lies between a calibration and a detector on one side and torques on the other.

    pip install 'approxjac[vision]'
    python examples/16_a_tag_in_its_pixels.py --out results/examples
"""

import argparse
from collections import deque
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import ModelGravity
from approxjac.errors import package_of
from approxjac.realtime import SimulatedDriver
from approxjac.tasks import CombinedTask, FrameKinematics

cv2 = package_of("vision", "cv2")  # says what to install where it is missing
arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)

K = np.array([[612.4, 0.0, 325.3], [0.0, 611.8, 236.9], [0.0, 0.0, 1.0]])
LENS = np.array([-0.28, 0.09, 1.1e-3, -7.0e-4, -1.2e-2])
SIZE, TAG = 0.10, np.eye(4)  # [m], and how it sits on the tip
TEXELS = np.float32([960.0, -960.0])  # [1/m]
TAG[:3, :3] = [[0.0, 0.5, 0.75**0.5], [1.0, 0.0, 0.0], [0.0, 0.75**0.5, -0.5]]
GOAL = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
START = GOAL + [0.15, -0.1, 0.1, 0.15, -0.1, 0.1, 0.3]

camera = aj.PinholeCamera.from_opencv(K, LENS, (640, 480))
camera = camera.standing_at((1.25, -0.25, 0.75), looking_at=(0.55, 0.0, 0.5))  # in truth
wrong = camera.with_error(rotation=(0.0, 0.0, np.radians(20.0)), shift=(0.05, 0.0, -0.15))
arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.15, 0.3, axis="x"), arm.with_object(0.0)  # weighed only
corners = aj.cameras.tag_corners(SIZE, TAG)


class Eye:
    """The true camera, which renders the true scene, and a detector of tags."""

    def __init__(self):
        pixels = np.mgrid[:480, :640][::-1].reshape(2, -1).T.astype(float)
        rays = cv2.undistortPoints(pixels[:, None], K, LENS)[:, 0]
        self.rays = np.float32(np.column_stack([rays, np.ones(len(rays))]))
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        marker = cv2.aruco.generateImageMarker(dictionary, 7, 96)
        self.texture = cv2.copyMakeBorder(marker, 24, 24, 24, 24, cv2.BORDER_CONSTANT, value=235)
        fine = cv2.aruco.DetectorParameters()
        fine.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self.detector = cv2.aruco.ArucoDetector(dictionary, fine)
        self.tip, self.rng = FrameKinematics(truth, truth.tip), np.random.default_rng(0)

    def image(self, q):
        """Return the image (480, 640) of the tag at a configuration."""
        (R, p), (R_c, p_c) = self.tip.placement(q), camera.placement()
        T = R_c.T @ np.column_stack([R @ TAG[:3, :2], R @ TAG[:3, 3] + p - p_c])
        meets = self.rays @ np.float32(np.linalg.inv(T).T)  # the tag's plane, by pixels
        where = (meets[:, :2] / meets[:, 2:] * TEXELS + 71.5).reshape(480, 640, 2)
        image = cv2.remap(self.texture, where, None, cv2.INTER_LINEAR, borderValue=120)
        noise = 3.0 * self.rng.standard_normal(image.shape, np.float32)
        image = cv2.GaussianBlur(image, (0, 0), 0.8) + noise
        return np.clip(image, 0.0, 255.0).astype(np.uint8)

    def corners(self, image):
        """Return the eight numbers of the corners that are found; NaN where no tag is."""
        found = self.detector.detectMarkers(image)[0] or [np.full(8, np.nan)]
        return found[0].astype(float).ravel()


eye, dt = Eye(), 1e-3  # [s]
x_d = eye.corners(eye.image(GOAL))  # the target is shown
task = CombinedTask.balanced(aj.ImageTask(belief, wrong, points=corners), x_d)
late = aj.Latency(period=dt, image_period=1 / 30, image_age=0.04)
law = aj.SetpointController(task, gravity=ModelGravity(truth), latency=late, settling_time=1.5)
loop = aj.HeldMeasurement(aj.TorqueLimited(law, aj.Limits.of(belief), dt=dt), unseen=60.0)

robot = SimulatedDriver(aj.Plant(truth), START, dt=dt, pace=np.inf)  # yours: tells q, q̇; takes τ
images, kept = deque([(np.full(8, np.nan), -np.inf)]), []
state = loop.initial_state(aj.Measurement(0.0, START, np.zeros(7), images[0][0]))
print("9 s of control at 30 images a second: this takes 5 s or more")
for step in range(round(9.0 / dt)):
    now, q, v, *_ = robot.read()
    if step % round(1 / 30 / dt) == 0:  # an image is there when it was looked through
        images.append((eye.corners(eye.image(q)), now))
    if len(images) > 1 and now - images[1][1] >= 0.04:
        images.popleft()
    measured = aj.Measurement(now, q, v, *images[0])
    state, answer = loop.step(state, measured, x_d, dt)
    robot.send(answer.torque)
    kept.append((step * dt, *(images[0][0] - x_d), *(answer.torque / truth.effort_limits)))
t, error, effort = np.split(np.array(kept), (1, 9), axis=1)
first, last = np.nanmax(np.abs(error)), np.abs(error[t[:, 0] > 8.0]).max()
print(f"largest error of a corner: {first:.0f} px at first, {last:.2f} px in the last second")
assert last < 1.5 < 100.0 < first  # NaN, had the tag been lost

figure, axes = view.new_figure(2, 2, title="A tag is brought to its target in an image")
with view.style():
    for ax, q, when in ((axes[0], START, "start"), (axes[1], robot.q, "end")):
        ax.imshow(eye.image(q), cmap="gray", vmin=0, vmax=255)
        there = np.append(x_d, x_d[:2]).reshape(5, 2).T
        ax.plot(*there, "x--", color=view.COLORS["target"], label="target of the corners")
        ax.set(title=f"Image at the {when}", xlabel="u [px]", ylabel="v [px]")
    distances = np.linalg.norm(error.reshape(-1, 4, 2), axis=2)
    axes[2].semilogy(t, distances, label=[f"corner {k}" for k in range(1, 5)])
    axes[2].set(title="Distances", xlabel="time [s]", ylabel="$‖x - x_d‖$ [px]", xlim=(0.0, 9.0))
    axes[3].plot(t, effort, label=truth.joint_names)
    axes[3].set(title="Torque of each joint", xlabel="time [s]", ylabel=r"$\tau$ / limit [–]")
for ax in axes:
    ax.set_xmargin(0.0)
    view.legend_below(ax)
print(*view.save_figure(figure, out / "16_tag_in_its_pixels"), sep="\n")
