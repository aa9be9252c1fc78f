"""URDFs of random trees: any axis, any kind of joint, branches, joints that mimic others."""

import numpy as np


def random_tree(rng, n=None):
    """Return the URDF of a tree of n links, by default 2 to 8, and the names of two of them."""
    n = int(rng.integers(2, 9)) if n is None else n
    parents = [int(rng.integers(max(-1, i - 3), i)) if i else -1 for i in range(n)]
    kinds = rng.choice(["revolute", "continuous", "prismatic"], n, p=[0.6, 0.2, 0.2])
    parts = ['<robot name="tree"><link name="base"/>']
    followers = set()
    for i, parent in enumerate(parents):
        mimic = ""
        # Pinocchio couples joints to those before them in its order: those that carry them
        leaders = [j for j in path(parents, parent) if kinds[j] != "continuous"]
        leaders = [j for j in leaders if j not in followers]
        if leaders and kinds[i] != "continuous" and rng.random() < 0.3:
            followers.add(i)
            mimic = f'<mimic joint="j{leaders[0]}" multiplier="{rng.normal()}" offset="0.1"/>'
        parts.append(link(f"l{i}", rng))
        parts.append(
            f'<joint name="j{i}" type="{kinds[i]}"><parent link="{name(parent)}"/>'
            f'<child link="l{i}"/>{origin(rng)}<axis xyz="{text(axis(rng))}"/>'
            f'<limit lower="-2" upper="2" effort="5" velocity="1"/>{mimic}</joint>'
        )
    parts.append('<link name="tool"/><joint name="hold" type="fixed"><child link="tool"/>')
    parts.append(f'<parent link="l{n - 1}"/>{origin(rng)}</joint></robot>')
    return "".join(parts), ("tool", f"l{n // 2}")


def path(parents, i):
    while i >= 0:
        yield i
        i = parents[i]


def name(i):
    return "base" if i < 0 else f"l{i}"


def axis(rng):
    if rng.random() < 0.6:
        return np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
    a = rng.normal(size=3)
    return a / np.linalg.norm(a)


def origin(rng):
    turn = rng.integers(-2, 3, 3) * np.pi / 2 if rng.random() < 0.5 else rng.uniform(-3, 3, 3)
    return f'<origin xyz="{text(rng.normal(size=3) * 0.3)}" rpy="{text(turn)}"/>'


def link(name, rng):
    A = rng.normal(size=(3, 3)) * 0.2
    second = A @ A.T + 0.01 * np.eye(3)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = np.trace(second) * np.eye(3) - second
    return (
        f'<link name="{name}"><inertial><origin xyz="{text(rng.normal(size=3) * 0.2)}"/>'
        f'<mass value="{rng.uniform(0.2, 3)}"/><inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" '
        f'iyy="{yy}" iyz="{yz}" izz="{zz}"/></inertial></link>'
    )


def text(numbers):
    return " ".join(map(str, np.asarray(numbers).tolist()))
