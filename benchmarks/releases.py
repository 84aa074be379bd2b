"""Pack a scored release of the diagnosis into one file, or write its labels and reports out again.

python benchmarks/releases.py pack FOLDER docs/results/releases/release_7.json.xz    # as the blind benchmark leaves it
python benchmarks/releases.py unpack docs/results/releases/release_6.json.xz FOLDER
"""

import argparse
from pathlib import Path

from soro_bench.leaderboard.diagnosis_entry import Release


def main() -> None:
    """Pack or unpack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    options = parser.parse_args()
    if options.do == "pack":
        Release.gather(options.source).pack(options.target)
    else:
        Release.load(options.source).unpack(options.target)


if __name__ == "__main__":
    main()
