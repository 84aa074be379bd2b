"""Matplotlib as plots and pages here use it."""

from types import ModuleType


def pyplot() -> ModuleType:
    """Matplotlib without a display, or ImportError with what to install."""
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("plots need matplotlib: pip install soro_bench[report]") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["text.parse_math"] = False  # names of a stranger's model are no formulas
    return plt
