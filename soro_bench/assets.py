"""Where the files of ``assets`` are, in a checkout and in an installed wheel."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


def asset_path(name: str) -> Path:
    """Path of ``assets/<name>``: beside the package in a checkout, inside it in a wheel."""
    for root in (_PACKAGE / "assets", _PACKAGE.parent / "assets"):
        if (path := root / name).exists():
            return path
    raise FileNotFoundError(f"no asset {name!r} in soro_bench's assets")


def mjcf_path(name: str) -> Path:
    """Path of ``assets/mjcf/<name>``."""
    return asset_path(f"mjcf/{name}")
