"""A scored release of the diagnosis in one file: the opened labels of its cases, and what the reports say of each.

The file is <name>.json.xz, some 100 KB. It holds what :func:`soro_bench.leaderboard.verify.verify_diagnosis` needs to
score the release again, and what a release is compared by: verdicts, effects with place, probability and parameters,
hypotheses, fits. Texts, forces and detection limits of the reports are left out.
"""

import json
import lzma
from dataclasses import dataclass
from pathlib import Path

from soro_bench.files import parsed_json, read_bytes, read_json, replacing, write_json

FORMAT = "soro_bench/release/1"
PACKED_BYTES, OPENED_BYTES = 1_000_000, 50_000_000
# keys of a report and of its effects that neither a score nor a comparison of releases reads
LEFT_OUT = {"rounds", "places", "residual_force", "detectable", "invisible", "next_recording", "audit"}
LEFT_OUT_OF_EFFECTS = {"when", "condition", "evidence", "against", "together_with"}


@dataclass(frozen=True)
class Release:
    """A release as it was scored.

    Args:
        digest: SHA-256 of the sealed labels, published before the first diagnosis.
        method: version of the method, as ``soro_bench.diagnosis.version`` gives it.
        labels: content of labels.json: seed, count, and what is hidden in every case.
        reports: by the case's id, without the keys that are left out.
    """

    digest: str
    method: str
    labels: dict
    reports: dict[str, dict]

    @classmethod
    def load(cls, path: str | Path) -> "Release":
        """Read a packed release; ValueError if the file is none."""
        try:
            opener = lzma.LZMADecompressor(memlimit=200_000_000)
            data = opener.decompress(read_bytes(path, PACKED_BYTES), OPENED_BYTES)
            if not opener.eof:
                raise ValueError(f"it is cut off, or longer than {OPENED_BYTES} bytes")
            found = parsed_json(data)
            if found["format"] != FORMAT:
                raise ValueError(f"its format is {found['format']!a}; {FORMAT} is needed")
            return cls(found["commitment"], found["method"], found["labels"], found["reports"])
        except (lzma.LZMAError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no release of the diagnosis: {error}") from error

    @classmethod
    def gather(cls, folder: str | Path) -> "Release":
        """The release that the blind benchmark left in ``folder``: its cases and a report for each."""
        cases, reports = Path(folder) / "cases", Path(folder) / "reports"
        found = {path.stem: _reduced(read_json(path)) for path in sorted(reports.glob("case_*.json"))}
        digest = (cases / "commitment.txt").read_text().strip()
        labels = read_json(cases / "sealed" / "labels.json", OPENED_BYTES)
        return cls(digest, (reports / "method.txt").read_text().strip(), labels, found)

    def pack(self, path: str | Path) -> None:
        """Write the release into one file."""
        content = {
            "format": FORMAT,
            "commitment": self.digest,
            "method": self.method,
            "labels": self.labels,
            "reports": self.reports,
        }
        data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        with replacing(path) as temporary:
            temporary.write_bytes(lzma.compress(data, preset=9 | lzma.PRESET_EXTREME))

    def unpack(self, folder: str | Path) -> None:
        """Write the release into ``folder`` as the blind benchmark does: cases/ with the labels, and reports/."""
        cases, reports = Path(folder) / "cases", Path(folder) / "reports"
        write_json(cases / "sealed" / "labels.json", self.labels)
        (cases / "commitment.txt").write_text(f"{self.digest}\n")
        for name, report in self.reports.items():
            if Path(name).name != name:
                raise ValueError(f"{name!a} is no name of a case")
            write_json(reports / f"{name}.json", report)
        (reports / "method.txt").write_text(f"{self.method}\n")


def _reduced(report: dict) -> dict:
    kept = {key: value for key, value in report.items() if key not in LEFT_OUT}
    effects = [{key: value for key, value in each.items() if key not in LEFT_OUT_OF_EFFECTS}
               for each in report["effects"]]  # fmt: skip
    return kept | {"effects": effects}
