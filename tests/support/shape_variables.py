"""Shape variables for equal weights, written out."""

from math import sqrt

SQRT2 = sqrt(2)


def variables(points):
    """Returns the shape variables of children with equal weights, written out from docs/architecture.md, 2.3."""
    found = [tuple((a - b) / SQRT2 for a, b in zip(points[0], points[1], strict=True))]
    for k in range(2, len(points)):
        mean = [sum(point[axis] for point in points[:k]) / k for axis in (0, 1)]
        found.append((points[k][0] - mean[0], points[k][1] - mean[1]))
    return found
