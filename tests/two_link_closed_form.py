"""An independent two-link arm, from the textbook's closed form. It imports nothing of ours.

Two uniform rods and a rod in line with the second one, in a vertical plane with coordinates
(x, y), gravity along −y.
"""

from dataclasses import dataclass

import numpy as np

G = 9.81


@dataclass(frozen=True)
class TwoLink:
    l1: float = 1.0
    l2: float = 1.0
    lo: float = 0.5
    m1: float = 2.0
    m2: float = 2.0
    mo: float = 0.5
    link_centre: float = 0.5  # centres of mass stay where they are when lengths are wrong

    def _outer(self):
        """Mass, first moment and second moment about joint 2 of link 2 with the object."""
        third = 1.0 / 12.0
        co = self.l2 + self.lo / 2.0
        mass = self.m2 + self.mo
        first = self.m2 * self.link_centre + self.mo * co
        second = self.m2 * (third + self.link_centre**2) + self.mo * (third * self.lo**2 + co**2)
        return mass, first, second

    def M(self, q):
        third = 1.0 / 12.0
        mass, first, second = self._outer()
        inner = self.m1 * (third + self.link_centre**2)
        c2 = np.cos(q[1])
        m12 = second + self.l1 * first * c2
        return np.array(
            [[inner + mass * self.l1**2 + second + 2.0 * self.l1 * first * c2, m12], [m12, second]]
        )

    def coriolis(self, q, v):
        h = self.l1 * self._outer()[1] * np.sin(q[1])
        return np.array([-h * (2.0 * v[0] * v[1] + v[1] ** 2), h * v[0] ** 2])

    def theta(self):
        mass, first, _ = self._outer()
        return np.array([self.m1 * self.link_centre + mass * self.l1, first])

    @staticmethod
    def Z(q):
        c1, c12 = np.cos(q[0]), np.cos(q[0] + q[1])
        return G * np.array([[c1, c12], [0.0, c12]])

    def g(self, q):
        return self.Z(q) @ self.theta()

    def h(self, q):
        r = self.l2 + self.lo
        q12 = q[0] + q[1]
        return np.array(
            [self.l1 * np.cos(q[0]) + r * np.cos(q12), self.l1 * np.sin(q[0]) + r * np.sin(q12)]
        )

    def J(self, q):
        r = self.l2 + self.lo
        q12 = q[0] + q[1]
        return np.array(
            [
                [-self.l1 * np.sin(q[0]) - r * np.sin(q12), -r * np.sin(q12)],
                [self.l1 * np.cos(q[0]) + r * np.cos(q12), r * np.cos(q12)],
            ]
        )


def camera(f, z, delta):
    """The paper's image of a point, as a matrix; its offset d is zero."""
    c, s = np.cos(delta), np.sin(delta)
    return f / (z - f) * np.array([[c, s], [-s, c]])
