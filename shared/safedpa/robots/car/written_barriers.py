"""The car's barriers as recorded from ``barriers.py``; written by ``safedpa.robots.car.generate_barriers``, not by hand."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin, sqrt
from typing import Any, final

from safedpa.equations.chain_rule import chain_rule

__all__ = ["WRITTEN", "Moving", "MovingTowing", "Open", "OpenTowing", "Sensed", "SensedTowing", "Still", "StillTowing", "Walled", "WalledTowing"]


@final
class Open:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n36 = (1.0) / p0_3
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n36: float = n36
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float]] = [(item[0], item[1],) for item in each[1]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            h.append(n33)
        for e1_0, e1_1 in self._items1:
            n34 = e1_1 - s3
            n35 = s3 - e1_0
            h += [n34, n35]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 2 * len(self._items1)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, _ = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                d_n31 = (n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (n29 / n32 if n32 > 0.0 else 1.0)
                d_n26 = d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n22, -d_n23, d_n16 * n15 + d_n15 * -n16, d_n19 * n18_3 + d_n21 * n20_3))
            else:
                which = (row - end1) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n36 = self._n36
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n37 = n1 / p0_2
        n38 = (n37 if n37 > n36 else n36)
        n39 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n40 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n41 = (n40 if n40 > n39 else n39)
        n42 = ((1.0) if (1.0) > n38 else n38)
        return (1.0), (1.0), n41, n42


@final
class Walled:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n52 = (1.0) / p0_3
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n52: float = n52
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float, float, float]] = [(item[0], item[1], item[2], item[3],) for item in each[1]]
        self._items2: list[tuple[float, float]] = [(item[0], item[1],) for item in each[2]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n35 = s0 + (n21 * n15)
        n37 = s1 + (n21 * n16)
        n43 = s0 + (n19 * n15)
        n45 = s1 + (n19 * n16)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            h.append(n33)
        for e1_0, e1_1, e1_2, e1_3 in self._items1:
            n38 = n35 - e1_0
            n39 = e1_1 - n35
            n40 = n37 - e1_2
            n41 = e1_3 - n37
            n46 = n43 - e1_0
            n47 = e1_1 - n43
            n48 = n45 - e1_2
            n49 = e1_3 - n45
            h += [n38, n39, n40, n41, n46, n47, n48, n49]
        for e2_0, e2_1 in self._items2:
            n50 = e2_1 - s3
            n51 = s3 - e2_0
            h += [n50, n51]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n34_2 = -n16 * n21
        n34_3 = n20_3 * n15
        n36_2 = n15 * n21
        n36_3 = n20_3 * n16
        n42_2 = -n16 * n19
        n42_3 = n18_3 * n15
        n44_2 = n15 * n19
        n44_3 = n18_3 * n16
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 8 * len(self._items1)
        end3 = end2 + 2 * len(self._items2)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, _ = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                d_n31 = (n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (n29 / n32 if n32 > 0.0 else 1.0)
                d_n26 = d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n22, -d_n23, d_n16 * n15 + d_n15 * -n16, d_n19 * n18_3 + d_n21 * n20_3))
            elif row < end2:
                which = (row - end1) % 8
                if which == 0:
                    found.append((1.0, 0.0, n34_2, n34_3))
                elif which == 1:
                    found.append((-1.0, 0.0, -n34_2, -n34_3))
                elif which == 2:
                    found.append((0.0, 1.0, n36_2, n36_3))
                elif which == 3:
                    found.append((0.0, -1.0, -n36_2, -n36_3))
                elif which == 4:
                    found.append((1.0, 0.0, n42_2, n42_3))
                elif which == 5:
                    found.append((-1.0, 0.0, -n42_2, -n42_3))
                elif which == 6:
                    found.append((0.0, 1.0, n44_2, n44_3))
                else:
                    found.append((0.0, -1.0, -n44_2, -n44_3))
            else:
                which = (row - end2) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n52 = self._n52
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n53 = n1 / p0_2
        n54 = (n53 if n53 > n52 else n52)
        n55 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n56 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n57 = (n56 if n56 > n55 else n55)
        n58 = ((1.0) if (1.0) > n54 else n54)
        return (1.0), (1.0), n57, n58


@final
class Sensed:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p1_0: float = shared[1][0]
        p1_1: float = shared[1][1]
        p1_2: float = shared[1][2]
        p1_3: float = shared[1][3]
        p1_4: float = shared[1][4]
        p1_5: float = shared[1][5]
        p1_6: float = shared[1][6]
        p1_7: float = shared[1][7]
        p1_8: float = shared[1][8]
        p1_9: float = shared[1][9]
        p1_10: float = shared[1][10]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n34 = p1_2 / p1_3
        n35 = n34 / p1_3
        n36 = n34 * n34
        n38 = (2.0) * p1_2
        n46 = -p1_0
        n55 = (2.0) * p1_4
        n59 = p1_5 * p1_5
        n61 = (2.0) * p1_6
        n109 = (1.0) / p0_3
        n115 = (1.0) / p1_3
        n125 = (1.0) / p1_6
        n126 = (1.0) / p1_4
        n127 = (n126 if n126 > n125 else n125)
        n132 = p1_7 * ((n127 if n127 > (0.5) else (0.5)))
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p1_1: float = p1_1
        self._p1_2: float = p1_2
        self._p1_3: float = p1_3
        self._p1_4: float = p1_4
        self._p1_5: float = p1_5
        self._p1_6: float = p1_6
        self._p1_8: float = p1_8
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n34: float = n34
        self._n35: float = n35
        self._n36: float = n36
        self._n38: float = n38
        self._n46: float = n46
        self._n55: float = n55
        self._n59: float = n59
        self._n61: float = n61
        self._n109: float = n109
        self._n115: float = n115
        self._n127: float = n127
        self._n132: float = n132
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float, float, float, float]] = [(item[0], item[1], item[2], item[3], item[4],) for item in each[1]]
        self._items2: list[tuple[float, float]] = [(item[0], item[1],) for item in each[2]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p1_1 = self._p1_1
        p1_4 = self._p1_4
        p1_5 = self._p1_5
        p1_6 = self._p1_6
        p1_8 = self._p1_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n46 = self._n46
        n55 = self._n55
        n59 = self._n59
        n61 = self._n61
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n51 = (p1_5 if p1_5 < n1 else n1)
        n52 = (p1_5 if p1_5 > n1 else n1)
        n63 = (((0.05) * n1) + ((n51 * n51) / n55)) + (((n52 * n52) - n59) / n61)
        n65 = (n63 if n11 else (-n63))
        n67 = n46 + (((0.0) if (0.0) < n65 else n65))
        n69 = p1_1 + (((0.0) if (0.0) > n65 else n65))
        n82 = s3 >= (0.0)
        n91 = n51 - (0.1)
        n95 = n1 - p1_5
        n98 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n91 else n91)) / p1_4)) + ((((0.0) if (0.0) > n95 else n95)) / p1_6)
        n102 = p1_8 * ((0.1) - n1)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            h.append(n33)
        for e1_0, e1_1, e1_2, e1_3, e1_4 in self._items1:
            n70 = e1_0 - s0
            n71 = e1_1 - s1
            n74 = (n15 * n70) + (n16 * n71)
            n77 = (n15 * n71) - (n16 * n70)
            n79 = n74 - ((n67 if n74 < n67 else n69 if n74 > n69 else n74))
            n80_square = n79 * n79 + n77 * n77
            n100 = (((sqrt(n80_square) if 1e-290 < n80_square < 1e+290 else hypot(n79, n77))) - e1_2) - (((e1_4 if ((((n46 - n74) if n82 else (n74 - p1_1))) > (0.0)) else e1_3)) * n98)
            n106 = (((n102 if n102 > n100 else n100)) if ((p1_8 * (e1_3 - e1_4)) > (0.0)) else n100)
            h.append(n106)
        for e2_0, e2_1 in self._items2:
            n107 = e2_1 - s3
            n108 = s3 - e2_0
            h += [n107, n108]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p1_1 = self._p1_1
        p1_4 = self._p1_4
        p1_5 = self._p1_5
        p1_6 = self._p1_6
        p1_8 = self._p1_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n46 = self._n46
        n55 = self._n55
        n59 = self._n59
        n61 = self._n61
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n51 = (p1_5 if p1_5 < n1 else n1)
        n52 = (p1_5 if p1_5 > n1 else n1)
        n63 = (((0.05) * n1) + ((n51 * n51) / n55)) + (((n52 * n52) - n59) / n61)
        n65 = (n63 if n11 else (-n63))
        n67 = n46 + (((0.0) if (0.0) < n65 else n65))
        n69 = p1_1 + (((0.0) if (0.0) > n65 else n65))
        n82 = s3 >= (0.0)
        n91 = n51 - (0.1)
        n95 = n1 - p1_5
        n98 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n91 else n91)) / p1_4)) + ((((0.0) if (0.0) > n95 else n95)) / p1_6)
        n102 = p1_8 * ((0.1) - n1)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n51_3 = (0.0 if p1_5 < n1 else n1_3)
        n52_3 = (0.0 if p1_5 > n1 else n1_3)
        n63_3 = ((n1_3 * (0.05)) + ((n51_3 * n51 + n51_3 * n51) / n55)) + ((n52_3 * n52 + n52_3 * n52) / n61)
        n65_3 = (n63_3 if n11 else 0.0) + (0.0 if n11 else -n63_3)
        n66_3 = (0.0 if (0.0) < n65 else n65_3)
        n68_3 = (0.0 if (0.0) > n65 else n65_3)
        n98_3 = ((((0.0 if (0.1) < n1 else n1_3)) * (0.5)) + (((0.0 if (0.0) > n91 else n51_3)) / p1_4)) + (((0.0 if (0.0) > n95 else n1_3)) / p1_6)
        n102_3 = -n1_3 * p1_8
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 1 * len(self._items1)
        end3 = end2 + 2 * len(self._items2)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, _ = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                d_n31 = (n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (n29 / n32 if n32 > 0.0 else 1.0)
                d_n26 = d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n22, -d_n23, d_n16 * n15 + d_n15 * -n16, d_n19 * n18_3 + d_n21 * n20_3))
            elif row < end2:
                e1_0, e1_1, e1_2, e1_3, e1_4 = self._items1[row - end1]
                n70 = e1_0 - s0
                n71 = e1_1 - s1
                n74 = (n15 * n70) + (n16 * n71)
                n77 = (n15 * n71) - (n16 * n70)
                n79 = n74 - ((n67 if n74 < n67 else n69 if n74 > n69 else n74))
                n80_square = n79 * n79 + n77 * n77
                n80 = (sqrt(n80_square) if 1e-290 < n80_square < 1e+290 else hypot(n79, n77))
                n87 = (e1_4 if ((((n46 - n74) if n82 else (n74 - p1_1))) > (0.0)) else e1_3)
                n100 = (n80 - e1_2) - (n87 * n98)
                n104 = (p1_8 * (e1_3 - e1_4)) > (0.0)
                d_n105 = (1.0 if n104 else 0.0)
                d_n100 = (0.0 if n104 else 1.0) + (0.0 if n102 > n100 else d_n105)
                d_n79 = (d_n100 * n79 / n80 if n80 > 0.0 else 0.0)
                d_n77 = (d_n100 * n77 / n80 if n80 > 0.0 else d_n100)
                d_n74 = d_n79 + (0.0 if n74 <= n67 else (0.0 if n74 >= n69 else -d_n79))
                d_n71 = d_n77 * n15 + d_n74 * n16
                d_n70 = -d_n77 * n16 + d_n74 * n15
                d_n102 = (d_n105 if n102 > n100 else 0.0)
                d_n98 = -d_n100 * n87
                d_n67 = (-d_n79 if n74 <= n67 else 0.0)
                d_n69 = (0.0 if n74 <= n67 else (-d_n79 if n74 >= n69 else 0.0))
                d_n16 = -d_n77 * n70 + d_n74 * n71
                d_n15 = d_n77 * n71 + d_n74 * n70
                found.append((-d_n70, -d_n71, d_n16 * n15 + d_n15 * -n16, d_n102 * n102_3 + d_n98 * n98_3 + d_n67 * n66_3 + d_n69 * n68_3))
            else:
                which = (row - end2) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        p1_1 = self._p1_1
        p1_2 = self._p1_2
        p1_3 = self._p1_3
        p1_5 = self._p1_5
        p1_8 = self._p1_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n34 = self._n34
        n35 = self._n35
        n36 = self._n36
        n38 = self._n38
        n46 = self._n46
        n55 = self._n55
        n59 = self._n59
        n61 = self._n61
        n109 = self._n109
        n115 = self._n115
        n127 = self._n127
        n132 = self._n132
        n1 = abs(s3)
        n3 = n1 * n1
        n8 = n2 + ((n3 - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n40 = n35 + ((n3 - n36) / n38)
        n45 = ((s3 / p1_3) if (n1 <= n34) else ((n40 if n11 else (-n40))))
        n51 = (p1_5 if p1_5 < n1 else n1)
        n52 = (p1_5 if p1_5 > n1 else n1)
        n63 = (((0.05) * n1) + ((n51 * n51) / n55)) + (((n52 * n52) - n59) / n61)
        n65 = (n63 if n11 else (-n63))
        n110 = n1 / p0_2
        n111 = (n110 if n110 > n109 else n109)
        n112 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n113 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n114 = (n113 if n113 > n112 else n112)
        n116 = n1 / p1_2
        n117 = (n116 if n116 > n115 else n115)
        n118 = abs((n46 + (((0.0) if (0.0) < n45 else n45))))
        n119 = abs((p1_1 + (((0.0) if (0.0) > n45 else n45))))
        n120 = (n119 if n119 > n118 else n118)
        n121 = abs((n46 + (((0.0) if (0.0) < n65 else n65))))
        n122 = abs((p1_1 + (((0.0) if (0.0) > n65 else n65))))
        n123 = (n122 if n122 > n121 else n121)
        n124 = (n123 if n123 > n120 else n120)
        n129 = (0.05) + (n1 * n127)
        n133 = ((n129 if n129 > n117 else n117)) + n132
        n134 = (p1_8 if p1_8 > n133 else n133)
        n135 = (n124 if n124 > n114 else n114)
        n136 = (n134 if n134 > n111 else n111)
        n137 = ((1.0) if (1.0) > n136 else n136)
        return (1.0), (1.0), n135, n137


@final
class Still:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n34 = (1.0) / p0_3
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n34: float = n34
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            h.append(n33)
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, _ = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                d_n31 = (n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (n29 / n32 if n32 > 0.0 else 1.0)
                d_n26 = d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n22, -d_n23, d_n16 * n15 + d_n15 * -n16, d_n19 * n18_3 + d_n21 * n20_3))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n34 = self._n34
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n35 = n1 / p0_2
        n36 = (n35 if n35 > n34 else n34)
        n37 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n38 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n39 = (n38 if n38 > n37 else n37)
        return (1.0), (1.0), n39, n36


@final
class Moving:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n26 = (2.0) * p0_4
        n30 = p0_5 * p0_5
        n32 = (2.0) * p0_6
        n78 = (1.0) / p0_3
        n88 = (1.0) / p0_6
        n89 = (1.0) / p0_4
        n90 = (n89 if n89 > n88 else n88)
        n95 = p0_7 * ((n90 if n90 > (0.5) else (0.5)))
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_8: float = p0_8
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n26: float = n26
        self._n30: float = n30
        self._n32: float = n32
        self._n78: float = n78
        self._n90: float = n90
        self._n95: float = n95
        self._items0: list[tuple[float, float, float, float, float]] = [(item[0], item[1], item[2], item[3], item[4],) for item in each[0]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_8 = self._p0_8
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n1 = abs(s3)
        n15 = cos(s2)
        n16 = sin(s2)
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if (s3 > (0.0)) else (-n34))
        n38 = n17 + (((0.0) if (0.0) < n36 else n36))
        n40 = p0_1 + (((0.0) if (0.0) > n36 else n36))
        n53 = s3 >= (0.0)
        n62 = n22 - (0.1)
        n66 = n1 - p0_5
        n69 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n62 else n62)) / p0_4)) + ((((0.0) if (0.0) > n66 else n66)) / p0_6)
        n73 = p0_8 * ((0.1) - n1)
        h: list[float] = []
        for e0_0, e0_1, e0_2, e0_3, e0_4 in self._items0:
            n41 = e0_0 - s0
            n42 = e0_1 - s1
            n45 = (n15 * n41) + (n16 * n42)
            n48 = (n15 * n42) - (n16 * n41)
            n50 = n45 - ((n38 if n45 < n38 else n40 if n45 > n40 else n45))
            n51_square = n50 * n50 + n48 * n48
            n71 = (((sqrt(n51_square) if 1e-290 < n51_square < 1e+290 else hypot(n50, n48))) - e0_2) - (((e0_4 if ((((n17 - n45) if n53 else (n45 - p0_1))) > (0.0)) else e0_3)) * n69)
            n77 = (((n73 if n73 > n71 else n71)) if ((p0_8 * (e0_3 - e0_4)) > (0.0)) else n71)
            h.append(n77)
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_8 = self._p0_8
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n1 = abs(s3)
        n11 = s3 > (0.0)
        n15 = cos(s2)
        n16 = sin(s2)
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if n11 else (-n34))
        n38 = n17 + (((0.0) if (0.0) < n36 else n36))
        n40 = p0_1 + (((0.0) if (0.0) > n36 else n36))
        n53 = s3 >= (0.0)
        n62 = n22 - (0.1)
        n66 = n1 - p0_5
        n69 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n62 else n62)) / p0_4)) + ((((0.0) if (0.0) > n66 else n66)) / p0_6)
        n73 = p0_8 * ((0.1) - n1)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n22_3 = (0.0 if p0_5 < n1 else n1_3)
        n23_3 = (0.0 if p0_5 > n1 else n1_3)
        n34_3 = ((n1_3 * (0.05)) + ((n22_3 * n22 + n22_3 * n22) / n26)) + ((n23_3 * n23 + n23_3 * n23) / n32)
        n36_3 = (n34_3 if n11 else 0.0) + (0.0 if n11 else -n34_3)
        n37_3 = (0.0 if (0.0) < n36 else n36_3)
        n39_3 = (0.0 if (0.0) > n36 else n36_3)
        n69_3 = ((((0.0 if (0.1) < n1 else n1_3)) * (0.5)) + (((0.0 if (0.0) > n62 else n22_3)) / p0_4)) + (((0.0 if (0.0) > n66 else n1_3)) / p0_6)
        n73_3 = -n1_3 * p0_8
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2, e0_3, e0_4 = self._items0[row - end0]
                n41 = e0_0 - s0
                n42 = e0_1 - s1
                n45 = (n15 * n41) + (n16 * n42)
                n48 = (n15 * n42) - (n16 * n41)
                n50 = n45 - ((n38 if n45 < n38 else n40 if n45 > n40 else n45))
                n51_square = n50 * n50 + n48 * n48
                n51 = (sqrt(n51_square) if 1e-290 < n51_square < 1e+290 else hypot(n50, n48))
                n58 = (e0_4 if ((((n17 - n45) if n53 else (n45 - p0_1))) > (0.0)) else e0_3)
                n71 = (n51 - e0_2) - (n58 * n69)
                n75 = (p0_8 * (e0_3 - e0_4)) > (0.0)
                d_n76 = (1.0 if n75 else 0.0)
                d_n71 = (0.0 if n75 else 1.0) + (0.0 if n73 > n71 else d_n76)
                d_n50 = (d_n71 * n50 / n51 if n51 > 0.0 else 0.0)
                d_n48 = (d_n71 * n48 / n51 if n51 > 0.0 else d_n71)
                d_n45 = d_n50 + (0.0 if n45 <= n38 else (0.0 if n45 >= n40 else -d_n50))
                d_n42 = d_n48 * n15 + d_n45 * n16
                d_n41 = -d_n48 * n16 + d_n45 * n15
                d_n73 = (d_n76 if n73 > n71 else 0.0)
                d_n69 = -d_n71 * n58
                d_n38 = (-d_n50 if n45 <= n38 else 0.0)
                d_n40 = (0.0 if n45 <= n38 else (-d_n50 if n45 >= n40 else 0.0))
                d_n16 = -d_n48 * n41 + d_n45 * n42
                d_n15 = d_n48 * n42 + d_n45 * n41
                found.append((-d_n41, -d_n42, d_n16 * n15 + d_n15 * -n16, d_n73 * n73_3 + d_n69 * n69_3 + d_n38 * n37_3 + d_n40 * n39_3))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        p0_5 = self._p0_5
        p0_8 = self._p0_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n78 = self._n78
        n90 = self._n90
        n95 = self._n95
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if n11 else (-n34))
        n79 = n1 / p0_2
        n80 = (n79 if n79 > n78 else n78)
        n81 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n82 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n83 = (n82 if n82 > n81 else n81)
        n84 = abs((n17 + (((0.0) if (0.0) < n36 else n36))))
        n85 = abs((p0_1 + (((0.0) if (0.0) > n36 else n36))))
        n86 = (n85 if n85 > n84 else n84)
        n87 = (n86 if n86 > n83 else n83)
        n92 = (0.05) + (n1 * n90)
        n96 = ((n92 if n92 > n80 else n80)) + n95
        n97 = (p0_8 if p0_8 > n96 else n96)
        return (1.0), (1.0), n87, n97


@final
class OpenTowing:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        p0_11: float = shared[0][11]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n55 = (1.0) / p0_3
        n61 = (1.0) + p0_5
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_7: float = p0_7
        self._p0_8: float = p0_8
        self._p0_9: float = p0_9
        self._p0_10: float = p0_10
        self._p0_11: float = p0_11
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n55: float = n55
        self._n61: float = n61
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float]] = [(item[0], item[1],) for item in each[1]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
            n49_square = n48 * n48 + n29 * n29
            n51 = (((sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))) - e0_2) - n46
            n52 = (n51 if n51 < n33 else n33)
            h.append(n52)
        for e1_0, e1_1 in self._items1:
            n53 = e1_1 - s3
            n54 = s3 - e1_0
            h += [n53, n54]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n46_0 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_10 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_1 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_11 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_3 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-n14_3 if n41 > (0.0) else 0.0)) * p0_5)))
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 2 * len(self._items1)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2 = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                n33 = n32 - e0_2
                n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
                n49_square = n48 * n48 + n29 * n29
                n49 = (sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))
                n51 = (n49 - e0_2) - n46
                d_n51 = (1.0 if n51 < n33 else 0.0)
                d_n48 = (d_n51 * n48 / n49 if n49 > 0.0 else 0.0)
                d_n33 = (0.0 if n51 < n33 else 1.0)
                d_n31 = (d_n33 * n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (d_n51 * n29 / n49 if n49 > 0.0 else d_n51) + (d_n33 * n29 / n32 if n32 > 0.0 else d_n33)
                d_n26 = d_n48 + (0.0 if n26 <= n19 else (0.0 if n26 >= n17 else -d_n48)) + d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n48 if n26 <= n19 else 0.0) + (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n51 * n46_0 - d_n22, -d_n51 * n46_1 - d_n23, d_n16 * n15 + d_n15 * -n16, -d_n51 * n46_3 + d_n19 * n18_3 + d_n21 * n20_3))
            else:
                which = (row - end1) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n55 = self._n55
        n61 = self._n61
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n56 = n1 / p0_2
        n58 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n59 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n60 = (n59 if n59 > n58 else n58)
        n62 = ((n56 if n56 > n55 else n55)) * n61
        n63 = ((1.0) if (1.0) > n62 else n62)
        return n61, n61, n60, n63


@final
class WalledTowing:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        p0_11: float = shared[0][11]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n92 = (1.0) / p0_3
        n98 = (1.0) + p0_5
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_7: float = p0_7
        self._p0_8: float = p0_8
        self._p0_9: float = p0_9
        self._p0_10: float = p0_10
        self._p0_11: float = p0_11
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n92: float = n92
        self._n98: float = n98
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float, float, float]] = [(item[0], item[1], item[2], item[3],) for item in each[1]]
        self._items2: list[tuple[float, float]] = [(item[0], item[1],) for item in each[2]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n54 = s0 + (n21 * n15)
        n56 = s1 + (n21 * n16)
        n62 = s0 + (n19 * n15)
        n64 = s1 + (n19 * n16)
        n69 = n46 > (0.0)
        n71 = s0 + (n17 * n15)
        n73 = s1 + (n17 * n16)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
            n49_square = n48 * n48 + n29 * n29
            n51 = (((sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))) - e0_2) - n46
            n52 = (n51 if n51 < n33 else n33)
            h.append(n52)
        for e1_0, e1_1, e1_2, e1_3 in self._items1:
            n57 = n54 - e1_0
            n58 = e1_1 - n54
            n59 = n56 - e1_2
            n60 = e1_3 - n56
            n65 = n62 - e1_0
            n66 = e1_1 - n62
            n67 = n64 - e1_2
            n68 = e1_3 - n64
            n74 = n71 - e1_0
            n75 = e1_1 - n71
            n76 = n73 - e1_2
            n77 = e1_3 - n73
            n86 = ((((n74 if n74 < n65 else n65)) - n46) if n69 else n65)
            n87 = ((((n75 if n75 < n66 else n66)) - n46) if n69 else n66)
            n88 = ((((n76 if n76 < n67 else n67)) - n46) if n69 else n67)
            n89 = ((((n77 if n77 < n68 else n68)) - n46) if n69 else n68)
            h += [n57, n58, n59, n60, n86, n87, n88, n89]
        for e2_0, e2_1 in self._items2:
            n90 = e2_1 - s3
            n91 = s3 - e2_0
            h += [n90, n91]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n62 = s0 + (n19 * n15)
        n64 = s1 + (n19 * n16)
        n69 = n46 > (0.0)
        n71 = s0 + (n17 * n15)
        n73 = s1 + (n17 * n16)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n46_0 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_10 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_1 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_11 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_3 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-n14_3 if n41 > (0.0) else 0.0)) * p0_5)))
        n53_2 = -n16 * n21
        n53_3 = n20_3 * n15
        n55_2 = n15 * n21
        n55_3 = n20_3 * n16
        n61_2 = -n16 * n19
        n61_3 = n18_3 * n15
        n63_2 = n15 * n19
        n63_3 = n18_3 * n16
        n70_2 = -n16 * n17
        n72_2 = n15 * n17
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 8 * len(self._items1)
        end3 = end2 + 2 * len(self._items2)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2 = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                n33 = n32 - e0_2
                n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
                n49_square = n48 * n48 + n29 * n29
                n49 = (sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))
                n51 = (n49 - e0_2) - n46
                d_n51 = (1.0 if n51 < n33 else 0.0)
                d_n48 = (d_n51 * n48 / n49 if n49 > 0.0 else 0.0)
                d_n33 = (0.0 if n51 < n33 else 1.0)
                d_n31 = (d_n33 * n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (d_n51 * n29 / n49 if n49 > 0.0 else d_n51) + (d_n33 * n29 / n32 if n32 > 0.0 else d_n33)
                d_n26 = d_n48 + (0.0 if n26 <= n19 else (0.0 if n26 >= n17 else -d_n48)) + d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n48 if n26 <= n19 else 0.0) + (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n51 * n46_0 - d_n22, -d_n51 * n46_1 - d_n23, d_n16 * n15 + d_n15 * -n16, -d_n51 * n46_3 + d_n19 * n18_3 + d_n21 * n20_3))
            elif row < end2:
                e1_0, e1_1, e1_2, e1_3 = self._items1[(row - end1) // 8]
                which = (row - end1) % 8
                if which == 0:
                    found.append((1.0, 0.0, n53_2, n53_3))
                elif which == 1:
                    found.append((-1.0, 0.0, -n53_2, -n53_3))
                elif which == 2:
                    found.append((0.0, 1.0, n55_2, n55_3))
                elif which == 3:
                    found.append((0.0, -1.0, -n55_2, -n55_3))
                elif which == 4:
                    n65 = n62 - e1_0
                    n74 = n71 - e1_0
                    d_n79 = (1.0 if n69 else 0.0)
                    d_n74 = (d_n79 if n74 < n65 else 0.0)
                    d_n65 = (0.0 if n69 else 1.0) + (0.0 if n74 < n65 else d_n79)
                    found.append((-d_n79 * n46_0 + d_n74 + d_n65, -d_n79 * n46_1, d_n74 * n70_2 + d_n65 * n61_2, -d_n79 * n46_3 + d_n65 * n61_3))
                elif which == 5:
                    n66 = e1_1 - n62
                    n75 = e1_1 - n71
                    d_n81 = (1.0 if n69 else 0.0)
                    d_n75 = (d_n81 if n75 < n66 else 0.0)
                    d_n66 = (0.0 if n69 else 1.0) + (0.0 if n75 < n66 else d_n81)
                    found.append((-d_n81 * n46_0 - d_n75 - d_n66, -d_n81 * n46_1, -d_n75 * n70_2 - d_n66 * n61_2, -d_n81 * n46_3 - d_n66 * n61_3))
                elif which == 6:
                    n67 = n64 - e1_2
                    n76 = n73 - e1_2
                    d_n83 = (1.0 if n69 else 0.0)
                    d_n76 = (d_n83 if n76 < n67 else 0.0)
                    d_n67 = (0.0 if n69 else 1.0) + (0.0 if n76 < n67 else d_n83)
                    found.append((-d_n83 * n46_0, -d_n83 * n46_1 + d_n76 + d_n67, d_n76 * n72_2 + d_n67 * n63_2, -d_n83 * n46_3 + d_n67 * n63_3))
                else:
                    n68 = e1_3 - n64
                    n77 = e1_3 - n73
                    d_n85 = (1.0 if n69 else 0.0)
                    d_n77 = (d_n85 if n77 < n68 else 0.0)
                    d_n68 = (0.0 if n69 else 1.0) + (0.0 if n77 < n68 else d_n85)
                    found.append((-d_n85 * n46_0, -d_n85 * n46_1 - d_n77 - d_n68, -d_n77 * n72_2 - d_n68 * n63_2, -d_n85 * n46_3 - d_n68 * n63_3))
            else:
                which = (row - end2) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n92 = self._n92
        n98 = self._n98
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n93 = n1 / p0_2
        n95 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n96 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n97 = (n96 if n96 > n95 else n95)
        n99 = ((n93 if n93 > n92 else n92)) * n98
        n100 = ((1.0) if (1.0) > n99 else n99)
        return n98, n98, n97, n100


@final
class SensedTowing:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        p0_11: float = shared[0][11]
        p1_0: float = shared[1][0]
        p1_1: float = shared[1][1]
        p1_2: float = shared[1][2]
        p1_3: float = shared[1][3]
        p1_4: float = shared[1][4]
        p1_5: float = shared[1][5]
        p1_6: float = shared[1][6]
        p1_7: float = shared[1][7]
        p1_8: float = shared[1][8]
        p1_9: float = shared[1][9]
        p1_10: float = shared[1][10]
        p1_11: float = shared[1][11]
        p1_12: float = shared[1][12]
        p1_13: float = shared[1][13]
        p1_14: float = shared[1][14]
        p1_15: float = shared[1][15]
        p1_16: float = shared[1][16]
        p1_17: float = shared[1][17]
        p1_18: float = shared[1][18]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n53 = p1_2 / p1_3
        n54 = n53 / p1_3
        n55 = n53 * n53
        n57 = (2.0) * p1_2
        n65 = -p1_0
        n74 = (2.0) * p1_4
        n78 = p1_5 * p1_5
        n80 = (2.0) * p1_6
        n127 = p1_9 + p1_10
        n168 = (1.0) / p0_3
        n174 = (1.0) + p0_5
        n176 = (1.0) / p1_3
        n182 = (1.0) + p1_12
        n188 = (1.0) / p1_6
        n189 = (1.0) / p1_4
        n190 = (n189 if n189 > n188 else n188)
        n196 = (1.0) + ((p1_12 * n127) / p1_13)
        n198 = (2.0) * n127
        n203 = p1_7 * ((n190 if n190 > (0.5) else (0.5)))
        n206 = (n196 if n196 > n174 else n174)
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_7: float = p0_7
        self._p0_8: float = p0_8
        self._p0_9: float = p0_9
        self._p0_10: float = p0_10
        self._p0_11: float = p0_11
        self._p1_0: float = p1_0
        self._p1_1: float = p1_1
        self._p1_2: float = p1_2
        self._p1_3: float = p1_3
        self._p1_4: float = p1_4
        self._p1_5: float = p1_5
        self._p1_6: float = p1_6
        self._p1_8: float = p1_8
        self._p1_9: float = p1_9
        self._p1_10: float = p1_10
        self._p1_11: float = p1_11
        self._p1_12: float = p1_12
        self._p1_13: float = p1_13
        self._p1_14: float = p1_14
        self._p1_15: float = p1_15
        self._p1_16: float = p1_16
        self._p1_17: float = p1_17
        self._p1_18: float = p1_18
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n53: float = n53
        self._n54: float = n54
        self._n55: float = n55
        self._n57: float = n57
        self._n65: float = n65
        self._n74: float = n74
        self._n78: float = n78
        self._n80: float = n80
        self._n127: float = n127
        self._n168: float = n168
        self._n174: float = n174
        self._n176: float = n176
        self._n182: float = n182
        self._n190: float = n190
        self._n196: float = n196
        self._n198: float = n198
        self._n203: float = n203
        self._n206: float = n206
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]
        self._items1: list[tuple[float, float, float, float, float]] = [(item[0], item[1], item[2], item[3], item[4],) for item in each[1]]
        self._items2: list[tuple[float, float]] = [(item[0], item[1],) for item in each[2]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        p1_0 = self._p1_0
        p1_1 = self._p1_1
        p1_3 = self._p1_3
        p1_4 = self._p1_4
        p1_5 = self._p1_5
        p1_6 = self._p1_6
        p1_8 = self._p1_8
        p1_9 = self._p1_9
        p1_10 = self._p1_10
        p1_11 = self._p1_11
        p1_12 = self._p1_12
        p1_13 = self._p1_13
        p1_14 = self._p1_14
        p1_15 = self._p1_15
        p1_16 = self._p1_16
        p1_17 = self._p1_17
        p1_18 = self._p1_18
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n53 = self._n53
        n54 = self._n54
        n55 = self._n55
        n57 = self._n57
        n65 = self._n65
        n74 = self._n74
        n78 = self._n78
        n80 = self._n80
        n127 = self._n127
        n1 = abs(s3)
        n3 = n1 * n1
        n8 = n2 + ((n3 - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n59 = n54 + ((n3 - n55) / n57)
        n70 = (p1_5 if p1_5 < n1 else n1)
        n71 = (p1_5 if p1_5 > n1 else n1)
        n82 = (((0.05) * n1) + ((n70 * n70) / n74)) + (((n71 * n71) - n78) / n80)
        n84 = (n82 if n11 else (-n82))
        n86 = n65 + (((0.0) if (0.0) < n84 else n84))
        n88 = p1_1 + (((0.0) if (0.0) > n84 else n84))
        n101 = s3 >= (0.0)
        n109 = (n88 - p1_1) - p1_0
        n119 = p1_14 - ((p1_17 * (s0 - p1_15)) + (p1_18 * (s1 - p1_16)))
        n121 = -(((s3 / p1_3) if (n1 <= n53) else ((n59 if n11 else (-n59)))))
        n125 = ((((n119 if n119 > (0.0) else (0.0))) + ((n121 if n121 > (0.0) else (0.0)))) - p1_11) * p1_12
        n131 = ((((0.0) if n125 < (0.0) else p1_13 if n125 > p1_13 else n125)) * n127) / p1_13
        n144 = n70 - (0.1)
        n148 = n1 - p1_5
        n151 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n144 else n144)) / p1_4)) + ((((0.0) if (0.0) > n148 else n148)) / p1_6)
        n154 = s3 >= (-0.01)
        n161 = p1_8 * ((0.1) - n1)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
            n49_square = n48 * n48 + n29 * n29
            n51 = (((sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))) - e0_2) - n46
            n52 = (n51 if n51 < n33 else n33)
            h.append(n52)
        for e1_0, e1_1, e1_2, e1_3, e1_4 in self._items1:
            n89 = e1_0 - s0
            n90 = e1_1 - s1
            n93 = (n15 * n89) + (n16 * n90)
            n96 = (n15 * n90) - (n16 * n89)
            n98 = n93 - ((n86 if n93 < n86 else n88 if n93 > n88 else n93))
            n99_square = n98 * n98 + n96 * n96
            n100 = ((sqrt(n99_square) if 1e-290 < n99_square < 1e+290 else hypot(n98, n96))) - e1_2
            n102 = n65 - n93
            n107 = e1_3 - e1_4
            n111 = n93 - ((n86 if n93 < n86 else n109 if n93 > n109 else n93))
            n112_square = n111 * n111 + n96 * n96
            n113 = ((sqrt(n112_square) if 1e-290 < n112_square < 1e+290 else hypot(n111, n96))) - p1_10
            n132 = ((n93 - n109) - (0.05)) - n131
            n134 = (abs(n96)) - n127
            n135 = ((0.0) if (0.0) > n132 else n132)
            n136 = ((0.0) if (0.0) > n134 else n134)
            n137_square = n135 * n135 + n136 * n136
            n138 = ((sqrt(n137_square) if 1e-290 < n137_square < 1e+290 else hypot(n135, n136))) + p1_9
            n140 = ((n138 if n138 > n113 else n113)) - e1_2
            n153 = ((n140 if n140 < n100 else n100)) - (((e1_4 if (((n102 if n101 else (n93 - p1_1))) > (0.0)) else e1_3)) * n151)
            n159 = ((((0.5) if (0.5) > n153 else n153)) if ((((n102 * n107) if n154 else (0.0))) > (0.0)) else n153)
            n165 = (((n161 if n161 > n159 else n159)) if ((p1_8 * n107) > (0.0)) else n159)
            h.append(n165)
        for e2_0, e2_1 in self._items2:
            n166 = e2_1 - s3
            n167 = s3 - e2_0
            h += [n166, n167]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        p1_0 = self._p1_0
        p1_1 = self._p1_1
        p1_3 = self._p1_3
        p1_4 = self._p1_4
        p1_5 = self._p1_5
        p1_6 = self._p1_6
        p1_8 = self._p1_8
        p1_9 = self._p1_9
        p1_10 = self._p1_10
        p1_11 = self._p1_11
        p1_12 = self._p1_12
        p1_13 = self._p1_13
        p1_14 = self._p1_14
        p1_15 = self._p1_15
        p1_16 = self._p1_16
        p1_17 = self._p1_17
        p1_18 = self._p1_18
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n53 = self._n53
        n54 = self._n54
        n55 = self._n55
        n57 = self._n57
        n65 = self._n65
        n74 = self._n74
        n78 = self._n78
        n80 = self._n80
        n127 = self._n127
        n1 = abs(s3)
        n3 = n1 * n1
        n8 = n2 + ((n3 - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n59 = n54 + ((n3 - n55) / n57)
        n60 = n1 <= n53
        n70 = (p1_5 if p1_5 < n1 else n1)
        n71 = (p1_5 if p1_5 > n1 else n1)
        n82 = (((0.05) * n1) + ((n70 * n70) / n74)) + (((n71 * n71) - n78) / n80)
        n84 = (n82 if n11 else (-n82))
        n86 = n65 + (((0.0) if (0.0) < n84 else n84))
        n88 = p1_1 + (((0.0) if (0.0) > n84 else n84))
        n101 = s3 >= (0.0)
        n109 = (n88 - p1_1) - p1_0
        n119 = p1_14 - ((p1_17 * (s0 - p1_15)) + (p1_18 * (s1 - p1_16)))
        n121 = -(((s3 / p1_3) if n60 else ((n59 if n11 else (-n59)))))
        n125 = ((((n119 if n119 > (0.0) else (0.0))) + ((n121 if n121 > (0.0) else (0.0)))) - p1_11) * p1_12
        n131 = ((((0.0) if n125 < (0.0) else p1_13 if n125 > p1_13 else n125)) * n127) / p1_13
        n144 = n70 - (0.1)
        n148 = n1 - p1_5
        n151 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n144 else n144)) / p1_4)) + ((((0.0) if (0.0) > n148 else n148)) / p1_6)
        n154 = s3 >= (-0.01)
        n161 = p1_8 * ((0.1) - n1)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n3_3 = n1_3 * n1 + n1_3 * n1
        n7_3 = n3_3 / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n46_0 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_10 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_1 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_11 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_3 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-n14_3 if n41 > (0.0) else 0.0)) * p0_5)))
        n58_3 = n3_3 / n57
        n70_3 = (0.0 if p1_5 < n1 else n1_3)
        n71_3 = (0.0 if p1_5 > n1 else n1_3)
        n82_3 = ((n1_3 * (0.05)) + ((n70_3 * n70 + n70_3 * n70) / n74)) + ((n71_3 * n71 + n71_3 * n71) / n80)
        n84_3 = (n82_3 if n11 else 0.0) + (0.0 if n11 else -n82_3)
        n85_3 = (0.0 if (0.0) < n84 else n84_3)
        n87_3 = (0.0 if (0.0) > n84 else n84_3)
        n131_0 = (((0.0 if n125 <= (0.0) else (0.0 if n125 >= p1_13 else (((-p1_17 if n119 > (0.0) else 0.0)) * p1_12)))) * n127) / p1_13
        n131_1 = (((0.0 if n125 <= (0.0) else (0.0 if n125 >= p1_13 else (((-p1_18 if n119 > (0.0) else 0.0)) * p1_12)))) * n127) / p1_13
        n131_3 = (((0.0 if n125 <= (0.0) else (0.0 if n125 >= p1_13 else (((-(((1.0 / p1_3) if n60 else 0.0) + (0.0 if n60 else ((n58_3 if n11 else 0.0) + (0.0 if n11 else -n58_3)))) if n121 > (0.0) else 0.0)) * p1_12)))) * n127) / p1_13
        n151_3 = ((((0.0 if (0.1) < n1 else n1_3)) * (0.5)) + (((0.0 if (0.0) > n144 else n70_3)) / p1_4)) + (((0.0 if (0.0) > n148 else n1_3)) / p1_6)
        n161_3 = -n1_3 * p1_8
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        end2 = end1 + 1 * len(self._items1)
        end3 = end2 + 2 * len(self._items2)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2 = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                n33 = n32 - e0_2
                n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
                n49_square = n48 * n48 + n29 * n29
                n49 = (sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))
                n51 = (n49 - e0_2) - n46
                d_n51 = (1.0 if n51 < n33 else 0.0)
                d_n48 = (d_n51 * n48 / n49 if n49 > 0.0 else 0.0)
                d_n33 = (0.0 if n51 < n33 else 1.0)
                d_n31 = (d_n33 * n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (d_n51 * n29 / n49 if n49 > 0.0 else d_n51) + (d_n33 * n29 / n32 if n32 > 0.0 else d_n33)
                d_n26 = d_n48 + (0.0 if n26 <= n19 else (0.0 if n26 >= n17 else -d_n48)) + d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n48 if n26 <= n19 else 0.0) + (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n51 * n46_0 - d_n22, -d_n51 * n46_1 - d_n23, d_n16 * n15 + d_n15 * -n16, -d_n51 * n46_3 + d_n19 * n18_3 + d_n21 * n20_3))
            elif row < end2:
                e1_0, e1_1, e1_2, e1_3, e1_4 = self._items1[row - end1]
                n89 = e1_0 - s0
                n90 = e1_1 - s1
                n93 = (n15 * n89) + (n16 * n90)
                n96 = (n15 * n90) - (n16 * n89)
                n98 = n93 - ((n86 if n93 < n86 else n88 if n93 > n88 else n93))
                n99_square = n98 * n98 + n96 * n96
                n99 = (sqrt(n99_square) if 1e-290 < n99_square < 1e+290 else hypot(n98, n96))
                n100 = n99 - e1_2
                n102 = n65 - n93
                n106 = (e1_4 if (((n102 if n101 else (n93 - p1_1))) > (0.0)) else e1_3)
                n107 = e1_3 - e1_4
                n111 = n93 - ((n86 if n93 < n86 else n109 if n93 > n109 else n93))
                n112_square = n111 * n111 + n96 * n96
                n112 = (sqrt(n112_square) if 1e-290 < n112_square < 1e+290 else hypot(n111, n96))
                n113 = n112 - p1_10
                n132 = ((n93 - n109) - (0.05)) - n131
                n134 = (abs(n96)) - n127
                n135 = ((0.0) if (0.0) > n132 else n132)
                n136 = ((0.0) if (0.0) > n134 else n134)
                n137_square = n135 * n135 + n136 * n136
                n137 = (sqrt(n137_square) if 1e-290 < n137_square < 1e+290 else hypot(n135, n136))
                n138 = n137 + p1_9
                n140 = ((n138 if n138 > n113 else n113)) - e1_2
                n153 = ((n140 if n140 < n100 else n100)) - (n106 * n151)
                n157 = (((n102 * n107) if n154 else (0.0))) > (0.0)
                n159 = ((((0.5) if (0.5) > n153 else n153)) if n157 else n153)
                n163 = (p1_8 * n107) > (0.0)
                d_n164 = (1.0 if n163 else 0.0)
                d_n159 = (0.0 if n163 else 1.0) + (0.0 if n161 > n159 else d_n164)
                d_n153 = (0.0 if n157 else d_n159) + (0.0 if (0.5) > n153 else ((d_n159 if n157 else 0.0)))
                d_n140 = (d_n153 if n140 < n100 else 0.0)
                d_n138 = (d_n140 if n138 > n113 else 0.0)
                d_n134 = (0.0 if (0.0) > n134 else ((d_n138 * n136 / n137 if n137 > 0.0 else d_n138)))
                d_n132 = (0.0 if (0.0) > n132 else ((d_n138 * n135 / n137 if n137 > 0.0 else 0.0)))
                d_n113 = (0.0 if n138 > n113 else d_n140)
                d_n111 = (d_n113 * n111 / n112 if n112 > 0.0 else 0.0)
                d_n100 = (0.0 if n140 < n100 else d_n153)
                d_n98 = (d_n100 * n98 / n99 if n99 > 0.0 else 0.0)
                d_n96 = (d_n134 if n96 > 0.0 else (-d_n134 if n96 < 0.0 else 0.0)) + (d_n113 * n96 / n112 if n112 > 0.0 else d_n113) + (d_n100 * n96 / n99 if n99 > 0.0 else d_n100)
                d_n93 = d_n132 + d_n111 + (0.0 if n93 <= n86 else (0.0 if n93 >= n109 else -d_n111)) + d_n98 + (0.0 if n93 <= n86 else (0.0 if n93 >= n88 else -d_n98))
                d_n90 = d_n96 * n15 + d_n93 * n16
                d_n89 = -d_n96 * n16 + d_n93 * n15
                d_n161 = (d_n164 if n161 > n159 else 0.0)
                d_n151 = -d_n153 * n106
                d_n109 = -d_n132 + (0.0 if n93 <= n86 else (-d_n111 if n93 >= n109 else 0.0))
                d_n86 = (-d_n111 if n93 <= n86 else 0.0) + (-d_n98 if n93 <= n86 else 0.0)
                d_n88 = (0.0 if n93 <= n86 else (-d_n98 if n93 >= n88 else 0.0))
                d_n16 = -d_n96 * n89 + d_n93 * n90
                d_n15 = d_n96 * n90 + d_n93 * n89
                found.append((-d_n132 * n131_0 - d_n89, -d_n132 * n131_1 - d_n90, d_n16 * n15 + d_n15 * -n16, d_n161 * n161_3 + d_n151 * n151_3 - d_n132 * n131_3 + d_n109 * n87_3 + d_n86 * n85_3 + d_n88 * n87_3))
            else:
                which = (row - end2) % 2
                if which == 0:
                    found.append((0.0, 0.0, 0.0, -1.0))
                else:
                    found.append((0.0, 0.0, 0.0, 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        p1_1 = self._p1_1
        p1_2 = self._p1_2
        p1_3 = self._p1_3
        p1_5 = self._p1_5
        p1_8 = self._p1_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n53 = self._n53
        n54 = self._n54
        n55 = self._n55
        n57 = self._n57
        n65 = self._n65
        n74 = self._n74
        n78 = self._n78
        n80 = self._n80
        n168 = self._n168
        n174 = self._n174
        n176 = self._n176
        n182 = self._n182
        n190 = self._n190
        n196 = self._n196
        n198 = self._n198
        n203 = self._n203
        n206 = self._n206
        n1 = abs(s3)
        n3 = n1 * n1
        n8 = n2 + ((n3 - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n59 = n54 + ((n3 - n55) / n57)
        n64 = ((s3 / p1_3) if (n1 <= n53) else ((n59 if n11 else (-n59))))
        n70 = (p1_5 if p1_5 < n1 else n1)
        n71 = (p1_5 if p1_5 > n1 else n1)
        n82 = (((0.05) * n1) + ((n70 * n70) / n74)) + (((n71 * n71) - n78) / n80)
        n84 = (n82 if n11 else (-n82))
        n88 = p1_1 + (((0.0) if (0.0) > n84 else n84))
        n169 = n1 / p0_2
        n171 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n172 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n173 = (n172 if n172 > n171 else n171)
        n175 = ((n169 if n169 > n168 else n168)) * n174
        n177 = n1 / p1_2
        n179 = abs((n65 + (((0.0) if (0.0) < n64 else n64))))
        n180 = abs((p1_1 + (((0.0) if (0.0) > n64 else n64))))
        n181 = (n180 if n180 > n179 else n179)
        n184 = abs((n65 + (((0.0) if (0.0) < n84 else n84))))
        n185 = abs(n88)
        n186 = (n185 if n185 > n184 else n184)
        n187 = (n186 if n186 > n181 else n181)
        n192 = (0.05) + (n1 * n190)
        n199 = (((0.0) if (0.0) > n88 else n88)) + n198
        n200 = (n199 if n199 > n187 else n187)
        n201 = (((n177 if n177 > n176 else n176)) * n182) * n196
        n204 = ((n192 if n192 > n201 else n201)) + n203
        n205 = (p1_8 if p1_8 > n204 else n204)
        n207 = (n200 if n200 > n173 else n173)
        n208 = (n205 if n205 > n175 else n175)
        n209 = ((1.0) if (1.0) > n208 else n208)
        return n206, n206, n207, n209


@final
class StillTowing:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        p0_11: float = shared[0][11]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n53 = (1.0) / p0_3
        n59 = (1.0) + p0_5
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_7: float = p0_7
        self._p0_8: float = p0_8
        self._p0_9: float = p0_9
        self._p0_10: float = p0_10
        self._p0_11: float = p0_11
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n53: float = n53
        self._n59: float = n59
        self._items0: list[tuple[float, float, float]] = [(item[0], item[1], item[2],) for item in each[0]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        h: list[float] = []
        for e0_0, e0_1, e0_2 in self._items0:
            n22 = e0_0 - s0
            n23 = e0_1 - s1
            n26 = (n15 * n22) + (n16 * n23)
            n29 = (n15 * n23) - (n16 * n22)
            n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
            n32_square = n31 * n31 + n29 * n29
            n33 = ((sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))) - e0_2
            n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
            n49_square = n48 * n48 + n29 * n29
            n51 = (((sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))) - e0_2) - n46
            n52 = (n51 if n51 < n33 else n33)
            h.append(n52)
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_7 = self._p0_7
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if n9 else ((n8 if n11 else (-n8))))
        n15 = cos(s2)
        n16 = sin(s2)
        n19 = n17 + (((0.0) if (0.0) < n14 else n14))
        n21 = p0_1 + (((0.0) if (0.0) > n14 else n14))
        n39 = p0_7 - ((p0_10 * (s0 - p0_8)) + (p0_11 * (s1 - p0_9)))
        n41 = -n14
        n45 = ((((n39 if n39 > (0.0) else (0.0))) + ((n41 if n41 > (0.0) else (0.0)))) - p0_4) * p0_5
        n46 = ((0.0) if n45 < (0.0) else p0_6 if n45 > p0_6 else n45)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n14_3 = ((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))
        n18_3 = (0.0 if (0.0) < n14 else n14_3)
        n20_3 = (0.0 if (0.0) > n14 else n14_3)
        n46_0 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_10 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_1 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-p0_11 if n39 > (0.0) else 0.0)) * p0_5)))
        n46_3 = (0.0 if n45 <= (0.0) else (0.0 if n45 >= p0_6 else (((-n14_3 if n41 > (0.0) else 0.0)) * p0_5)))
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2 = self._items0[row - end0]
                n22 = e0_0 - s0
                n23 = e0_1 - s1
                n26 = (n15 * n22) + (n16 * n23)
                n29 = (n15 * n23) - (n16 * n22)
                n31 = n26 - ((n19 if n26 < n19 else n21 if n26 > n21 else n26))
                n32_square = n31 * n31 + n29 * n29
                n32 = (sqrt(n32_square) if 1e-290 < n32_square < 1e+290 else hypot(n31, n29))
                n33 = n32 - e0_2
                n48 = n26 - ((n19 if n26 < n19 else n17 if n26 > n17 else n26))
                n49_square = n48 * n48 + n29 * n29
                n49 = (sqrt(n49_square) if 1e-290 < n49_square < 1e+290 else hypot(n48, n29))
                n51 = (n49 - e0_2) - n46
                d_n51 = (1.0 if n51 < n33 else 0.0)
                d_n48 = (d_n51 * n48 / n49 if n49 > 0.0 else 0.0)
                d_n33 = (0.0 if n51 < n33 else 1.0)
                d_n31 = (d_n33 * n31 / n32 if n32 > 0.0 else 0.0)
                d_n29 = (d_n51 * n29 / n49 if n49 > 0.0 else d_n51) + (d_n33 * n29 / n32 if n32 > 0.0 else d_n33)
                d_n26 = d_n48 + (0.0 if n26 <= n19 else (0.0 if n26 >= n17 else -d_n48)) + d_n31 + (0.0 if n26 <= n19 else (0.0 if n26 >= n21 else -d_n31))
                d_n23 = d_n29 * n15 + d_n26 * n16
                d_n22 = -d_n29 * n16 + d_n26 * n15
                d_n19 = (-d_n48 if n26 <= n19 else 0.0) + (-d_n31 if n26 <= n19 else 0.0)
                d_n21 = (0.0 if n26 <= n19 else (-d_n31 if n26 >= n21 else 0.0))
                d_n16 = -d_n29 * n22 + d_n26 * n23
                d_n15 = d_n29 * n23 + d_n26 * n22
                found.append((-d_n51 * n46_0 - d_n22, -d_n51 * n46_1 - d_n23, d_n16 * n15 + d_n15 * -n16, -d_n51 * n46_3 + d_n19 * n18_3 + d_n21 * n20_3))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n53 = self._n53
        n59 = self._n59
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if (s3 > (0.0)) else (-n8))))
        n54 = n1 / p0_2
        n56 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n57 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n58 = (n57 if n57 > n56 else n56)
        n60 = ((n54 if n54 > n53 else n53)) * n59
        return n59, n59, n58, n60


@final
class MovingTowing:
    """h of all rows at a state, and its slopes."""

    def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:
        p0_0: float = shared[0][0]
        p0_1: float = shared[0][1]
        p0_2: float = shared[0][2]
        p0_3: float = shared[0][3]
        p0_4: float = shared[0][4]
        p0_5: float = shared[0][5]
        p0_6: float = shared[0][6]
        p0_7: float = shared[0][7]
        p0_8: float = shared[0][8]
        p0_9: float = shared[0][9]
        p0_10: float = shared[0][10]
        p0_11: float = shared[0][11]
        p0_12: float = shared[0][12]
        p0_13: float = shared[0][13]
        p0_14: float = shared[0][14]
        p0_15: float = shared[0][15]
        p0_16: float = shared[0][16]
        p0_17: float = shared[0][17]
        p0_18: float = shared[0][18]
        n0 = p0_2 / p0_3
        n2 = n0 / p0_3
        n4 = n0 * n0
        n6 = (2.0) * p0_2
        n17 = -p0_0
        n26 = (2.0) * p0_4
        n30 = p0_5 * p0_5
        n32 = (2.0) * p0_6
        n79 = p0_9 + p0_10
        n118 = (1.0) / p0_3
        n124 = (1.0) + p0_12
        n130 = (1.0) / p0_6
        n131 = (1.0) / p0_4
        n132 = (n131 if n131 > n130 else n130)
        n138 = (1.0) + ((p0_12 * n79) / p0_13)
        n140 = (2.0) * n79
        n145 = p0_7 * ((n132 if n132 > (0.5) else (0.5)))
        self._p0_0: float = p0_0
        self._p0_1: float = p0_1
        self._p0_2: float = p0_2
        self._p0_3: float = p0_3
        self._p0_4: float = p0_4
        self._p0_5: float = p0_5
        self._p0_6: float = p0_6
        self._p0_8: float = p0_8
        self._p0_9: float = p0_9
        self._p0_10: float = p0_10
        self._p0_11: float = p0_11
        self._p0_12: float = p0_12
        self._p0_13: float = p0_13
        self._p0_14: float = p0_14
        self._p0_15: float = p0_15
        self._p0_16: float = p0_16
        self._p0_17: float = p0_17
        self._p0_18: float = p0_18
        self._n0: float = n0
        self._n2: float = n2
        self._n4: float = n4
        self._n6: float = n6
        self._n17: float = n17
        self._n26: float = n26
        self._n30: float = n30
        self._n32: float = n32
        self._n79: float = n79
        self._n118: float = n118
        self._n124: float = n124
        self._n132: float = n132
        self._n138: float = n138
        self._n140: float = n140
        self._n145: float = n145
        self._items0: list[tuple[float, float, float, float, float]] = [(item[0], item[1], item[2], item[3], item[4],) for item in each[0]]

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows,) at ``state``."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_0 = self._p0_0
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        p0_12 = self._p0_12
        p0_13 = self._p0_13
        p0_14 = self._p0_14
        p0_15 = self._p0_15
        p0_16 = self._p0_16
        p0_17 = self._p0_17
        p0_18 = self._p0_18
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n79 = self._n79
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n11 = s3 > (0.0)
        n15 = cos(s2)
        n16 = sin(s2)
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if n11 else (-n34))
        n38 = n17 + (((0.0) if (0.0) < n36 else n36))
        n40 = p0_1 + (((0.0) if (0.0) > n36 else n36))
        n53 = s3 >= (0.0)
        n61 = (n40 - p0_1) - p0_0
        n71 = p0_14 - ((p0_17 * (s0 - p0_15)) + (p0_18 * (s1 - p0_16)))
        n73 = -(((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8)))))
        n77 = ((((n71 if n71 > (0.0) else (0.0))) + ((n73 if n73 > (0.0) else (0.0)))) - p0_11) * p0_12
        n83 = ((((0.0) if n77 < (0.0) else p0_13 if n77 > p0_13 else n77)) * n79) / p0_13
        n96 = n22 - (0.1)
        n100 = n1 - p0_5
        n103 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n96 else n96)) / p0_4)) + ((((0.0) if (0.0) > n100 else n100)) / p0_6)
        n106 = s3 >= (-0.01)
        n113 = p0_8 * ((0.1) - n1)
        h: list[float] = []
        for e0_0, e0_1, e0_2, e0_3, e0_4 in self._items0:
            n41 = e0_0 - s0
            n42 = e0_1 - s1
            n45 = (n15 * n41) + (n16 * n42)
            n48 = (n15 * n42) - (n16 * n41)
            n50 = n45 - ((n38 if n45 < n38 else n40 if n45 > n40 else n45))
            n51_square = n50 * n50 + n48 * n48
            n52 = ((sqrt(n51_square) if 1e-290 < n51_square < 1e+290 else hypot(n50, n48))) - e0_2
            n54 = n17 - n45
            n59 = e0_3 - e0_4
            n63 = n45 - ((n38 if n45 < n38 else n61 if n45 > n61 else n45))
            n64_square = n63 * n63 + n48 * n48
            n65 = ((sqrt(n64_square) if 1e-290 < n64_square < 1e+290 else hypot(n63, n48))) - p0_10
            n84 = ((n45 - n61) - (0.05)) - n83
            n86 = (abs(n48)) - n79
            n87 = ((0.0) if (0.0) > n84 else n84)
            n88 = ((0.0) if (0.0) > n86 else n86)
            n89_square = n87 * n87 + n88 * n88
            n90 = ((sqrt(n89_square) if 1e-290 < n89_square < 1e+290 else hypot(n87, n88))) + p0_9
            n92 = ((n90 if n90 > n65 else n65)) - e0_2
            n105 = ((n92 if n92 < n52 else n52)) - (((e0_4 if (((n54 if n53 else (n45 - p0_1))) > (0.0)) else e0_3)) * n103)
            n111 = ((((0.5) if (0.5) > n105 else n105)) if ((((n54 * n59) if n106 else (0.0))) > (0.0)) else n105)
            n117 = (((n113 if n113 > n111 else n111)) if ((p0_8 * n59) > (0.0)) else n111)
            h.append(n117)
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[tuple[float, float, float, float]]:
        """d(h_i)/d(state) of the rows asked for."""
        s0: float = state[0]
        s1: float = state[1]
        s2: float = state[2]
        s3: float = state[3]
        p0_0 = self._p0_0
        p0_1 = self._p0_1
        p0_3 = self._p0_3
        p0_4 = self._p0_4
        p0_5 = self._p0_5
        p0_6 = self._p0_6
        p0_8 = self._p0_8
        p0_9 = self._p0_9
        p0_10 = self._p0_10
        p0_11 = self._p0_11
        p0_12 = self._p0_12
        p0_13 = self._p0_13
        p0_14 = self._p0_14
        p0_15 = self._p0_15
        p0_16 = self._p0_16
        p0_17 = self._p0_17
        p0_18 = self._p0_18
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n79 = self._n79
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n9 = n1 <= n0
        n11 = s3 > (0.0)
        n15 = cos(s2)
        n16 = sin(s2)
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if n11 else (-n34))
        n38 = n17 + (((0.0) if (0.0) < n36 else n36))
        n40 = p0_1 + (((0.0) if (0.0) > n36 else n36))
        n53 = s3 >= (0.0)
        n61 = (n40 - p0_1) - p0_0
        n71 = p0_14 - ((p0_17 * (s0 - p0_15)) + (p0_18 * (s1 - p0_16)))
        n73 = -(((s3 / p0_3) if n9 else ((n8 if n11 else (-n8)))))
        n77 = ((((n71 if n71 > (0.0) else (0.0))) + ((n73 if n73 > (0.0) else (0.0)))) - p0_11) * p0_12
        n83 = ((((0.0) if n77 < (0.0) else p0_13 if n77 > p0_13 else n77)) * n79) / p0_13
        n96 = n22 - (0.1)
        n100 = n1 - p0_5
        n103 = (((((0.1) if (0.1) < n1 else n1)) * (0.5)) + ((((0.0) if (0.0) > n96 else n96)) / p0_4)) + ((((0.0) if (0.0) > n100 else n100)) / p0_6)
        n106 = s3 >= (-0.01)
        n113 = p0_8 * ((0.1) - n1)
        n1_3 = (1.0 if s3 > 0.0 else (-1.0 if s3 < 0.0 else 0.0))
        n7_3 = (n1_3 * n1 + n1_3 * n1) / n6
        n22_3 = (0.0 if p0_5 < n1 else n1_3)
        n23_3 = (0.0 if p0_5 > n1 else n1_3)
        n34_3 = ((n1_3 * (0.05)) + ((n22_3 * n22 + n22_3 * n22) / n26)) + ((n23_3 * n23 + n23_3 * n23) / n32)
        n36_3 = (n34_3 if n11 else 0.0) + (0.0 if n11 else -n34_3)
        n37_3 = (0.0 if (0.0) < n36 else n36_3)
        n39_3 = (0.0 if (0.0) > n36 else n36_3)
        n83_0 = (((0.0 if n77 <= (0.0) else (0.0 if n77 >= p0_13 else (((-p0_17 if n71 > (0.0) else 0.0)) * p0_12)))) * n79) / p0_13
        n83_1 = (((0.0 if n77 <= (0.0) else (0.0 if n77 >= p0_13 else (((-p0_18 if n71 > (0.0) else 0.0)) * p0_12)))) * n79) / p0_13
        n83_3 = (((0.0 if n77 <= (0.0) else (0.0 if n77 >= p0_13 else (((-(((1.0 / p0_3) if n9 else 0.0) + (0.0 if n9 else ((n7_3 if n11 else 0.0) + (0.0 if n11 else -n7_3)))) if n73 > (0.0) else 0.0)) * p0_12)))) * n79) / p0_13
        n103_3 = ((((0.0 if (0.1) < n1 else n1_3)) * (0.5)) + (((0.0 if (0.0) > n96 else n22_3)) / p0_4)) + (((0.0 if (0.0) > n100 else n1_3)) / p0_6)
        n113_3 = -n1_3 * p0_8
        end0 = 0
        end1 = end0 + 1 * len(self._items0)
        found: list[tuple[float, float, float, float]] = []
        for row in rows:
            if row < end1:
                e0_0, e0_1, e0_2, e0_3, e0_4 = self._items0[row - end0]
                n41 = e0_0 - s0
                n42 = e0_1 - s1
                n45 = (n15 * n41) + (n16 * n42)
                n48 = (n15 * n42) - (n16 * n41)
                n50 = n45 - ((n38 if n45 < n38 else n40 if n45 > n40 else n45))
                n51_square = n50 * n50 + n48 * n48
                n51 = (sqrt(n51_square) if 1e-290 < n51_square < 1e+290 else hypot(n50, n48))
                n52 = n51 - e0_2
                n54 = n17 - n45
                n58 = (e0_4 if (((n54 if n53 else (n45 - p0_1))) > (0.0)) else e0_3)
                n59 = e0_3 - e0_4
                n63 = n45 - ((n38 if n45 < n38 else n61 if n45 > n61 else n45))
                n64_square = n63 * n63 + n48 * n48
                n64 = (sqrt(n64_square) if 1e-290 < n64_square < 1e+290 else hypot(n63, n48))
                n65 = n64 - p0_10
                n84 = ((n45 - n61) - (0.05)) - n83
                n86 = (abs(n48)) - n79
                n87 = ((0.0) if (0.0) > n84 else n84)
                n88 = ((0.0) if (0.0) > n86 else n86)
                n89_square = n87 * n87 + n88 * n88
                n89 = (sqrt(n89_square) if 1e-290 < n89_square < 1e+290 else hypot(n87, n88))
                n90 = n89 + p0_9
                n92 = ((n90 if n90 > n65 else n65)) - e0_2
                n105 = ((n92 if n92 < n52 else n52)) - (n58 * n103)
                n109 = (((n54 * n59) if n106 else (0.0))) > (0.0)
                n111 = ((((0.5) if (0.5) > n105 else n105)) if n109 else n105)
                n115 = (p0_8 * n59) > (0.0)
                d_n116 = (1.0 if n115 else 0.0)
                d_n111 = (0.0 if n115 else 1.0) + (0.0 if n113 > n111 else d_n116)
                d_n105 = (0.0 if n109 else d_n111) + (0.0 if (0.5) > n105 else ((d_n111 if n109 else 0.0)))
                d_n92 = (d_n105 if n92 < n52 else 0.0)
                d_n90 = (d_n92 if n90 > n65 else 0.0)
                d_n86 = (0.0 if (0.0) > n86 else ((d_n90 * n88 / n89 if n89 > 0.0 else d_n90)))
                d_n84 = (0.0 if (0.0) > n84 else ((d_n90 * n87 / n89 if n89 > 0.0 else 0.0)))
                d_n65 = (0.0 if n90 > n65 else d_n92)
                d_n63 = (d_n65 * n63 / n64 if n64 > 0.0 else 0.0)
                d_n52 = (0.0 if n92 < n52 else d_n105)
                d_n50 = (d_n52 * n50 / n51 if n51 > 0.0 else 0.0)
                d_n48 = (d_n86 if n48 > 0.0 else (-d_n86 if n48 < 0.0 else 0.0)) + (d_n65 * n48 / n64 if n64 > 0.0 else d_n65) + (d_n52 * n48 / n51 if n51 > 0.0 else d_n52)
                d_n45 = d_n84 + d_n63 + (0.0 if n45 <= n38 else (0.0 if n45 >= n61 else -d_n63)) + d_n50 + (0.0 if n45 <= n38 else (0.0 if n45 >= n40 else -d_n50))
                d_n42 = d_n48 * n15 + d_n45 * n16
                d_n41 = -d_n48 * n16 + d_n45 * n15
                d_n113 = (d_n116 if n113 > n111 else 0.0)
                d_n103 = -d_n105 * n58
                d_n61 = -d_n84 + (0.0 if n45 <= n38 else (-d_n63 if n45 >= n61 else 0.0))
                d_n38 = (-d_n63 if n45 <= n38 else 0.0) + (-d_n50 if n45 <= n38 else 0.0)
                d_n40 = (0.0 if n45 <= n38 else (-d_n50 if n45 >= n40 else 0.0))
                d_n16 = -d_n48 * n41 + d_n45 * n42
                d_n15 = d_n48 * n42 + d_n45 * n41
                found.append((-d_n84 * n83_0 - d_n41, -d_n84 * n83_1 - d_n42, d_n16 * n15 + d_n15 * -n16, d_n113 * n113_3 + d_n103 * n103_3 - d_n84 * n83_3 + d_n61 * n39_3 + d_n38 * n37_3 + d_n40 * n39_3))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> tuple[float, float, float, float]:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        s3: float = state[3]
        p0_1 = self._p0_1
        p0_2 = self._p0_2
        p0_3 = self._p0_3
        p0_5 = self._p0_5
        p0_8 = self._p0_8
        n0 = self._n0
        n2 = self._n2
        n4 = self._n4
        n6 = self._n6
        n17 = self._n17
        n26 = self._n26
        n30 = self._n30
        n32 = self._n32
        n118 = self._n118
        n124 = self._n124
        n132 = self._n132
        n138 = self._n138
        n140 = self._n140
        n145 = self._n145
        n1 = abs(s3)
        n8 = n2 + (((n1 * n1) - n4) / n6)
        n11 = s3 > (0.0)
        n14 = ((s3 / p0_3) if (n1 <= n0) else ((n8 if n11 else (-n8))))
        n22 = (p0_5 if p0_5 < n1 else n1)
        n23 = (p0_5 if p0_5 > n1 else n1)
        n34 = (((0.05) * n1) + ((n22 * n22) / n26)) + (((n23 * n23) - n30) / n32)
        n36 = (n34 if n11 else (-n34))
        n40 = p0_1 + (((0.0) if (0.0) > n36 else n36))
        n119 = n1 / p0_2
        n121 = abs((n17 + (((0.0) if (0.0) < n14 else n14))))
        n122 = abs((p0_1 + (((0.0) if (0.0) > n14 else n14))))
        n123 = (n122 if n122 > n121 else n121)
        n126 = abs((n17 + (((0.0) if (0.0) < n36 else n36))))
        n127 = abs(n40)
        n128 = (n127 if n127 > n126 else n126)
        n129 = (n128 if n128 > n123 else n123)
        n134 = (0.05) + (n1 * n132)
        n141 = (((0.0) if (0.0) > n40 else n40)) + n140
        n142 = (n141 if n141 > n129 else n129)
        n143 = (((n119 if n119 > n118 else n118)) * n124) * n138
        n146 = ((n134 if n134 > n143 else n143)) + n145
        n147 = (p0_8 if p0_8 > n146 else n146)
        return n138, n138, n142, n147


WRITTEN: dict[str, Any] = {
    "4: ObstacleBarrier 4 3 () -1, SpeedBarrier 0 2 (3,) -1": Open,
    "4: ObstacleBarrier 4 3 () -1, FieldBarrier 4 4 () 0, SpeedBarrier 0 2 (3,) -1": Walled,
    "4: ObstacleBarrier 4 3 () -1, MovingObstacleBarrier 11 5 () -1, SpeedBarrier 0 2 (3,) -1": Sensed,
    "4: ObstacleBarrier 4 3 () -1": Still,
    "4: MovingObstacleBarrier 11 5 () -1": Moving,
    "4: ObstacleBarrier 12 3 () -1, SpeedBarrier 0 2 (3,) -1": OpenTowing,
    "4: ObstacleBarrier 12 3 () -1, FieldBarrier 12 4 () 0, SpeedBarrier 0 2 (3,) -1": WalledTowing,
    "4: ObstacleBarrier 12 3 () -1, MovingObstacleBarrier 19 5 () -1, SpeedBarrier 0 2 (3,) -1": SensedTowing,
    "4: ObstacleBarrier 12 3 () -1": StillTowing,
    "4: MovingObstacleBarrier 19 5 () -1": MovingTowing,
}
"""By what was recorded."""
