"""Whether there must be a real vcan."""

import os


def vcan_required() -> bool:
    """Whether there must be a vcan, and none of its tests may be skipped."""
    return bool(os.environ.get("CI") or os.environ.get("ECHELON_REQUIRE_VCAN"))
