"""Check that the wheel and the source archive hold what Git tracks for them, and nothing else.

Usage: python .ci/check_archives.py DIST, a folder with one of each.
"""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path


def compare(archive: Path, found: set[str], expected: set[str]) -> None:
    """Stop with the names that one has and the other lacks."""
    if found != expected:
        sys.exit(
            f"{archive.name} lacks {sorted(expected - found)} and has "
            f"{sorted(found - expected)} besides"
        )
    print(f"{archive.name}: {len(found)} files, {archive.stat().st_size / 1e6:.2f} MB")


(wheel,) = Path(sys.argv[1]).glob("*.whl")
(source,) = Path(sys.argv[1]).glob("*.tar.gz")
tracked = set(subprocess.check_output(["git", "ls-files"], text=True).splitlines())

package = {name.removeprefix("src/") for name in tracked if name.startswith("src/")}
package |= {f"approxjac/{name}" for name in tracked if name.startswith("urdf/")}
for needed in ("approxjac/py.typed", "approxjac/urdf/two_link.urdf"):
    if needed not in package:
        sys.exit(f"{needed} is not tracked by Git")
about = "-".join(wheel.name.split("-")[:2]) + ".dist-info"
package |= {f"{about}/{name}" for name in ("METADATA", "WHEEL", "RECORD", "entry_points.txt")}
licences = ("LICENSE", "src/approxjac/view/browser/assets/uPlot.LICENSE")
package |= {f"{about}/licenses/{name}" for name in licences}
with zipfile.ZipFile(wheel) as archive:
    compare(wheel, set(archive.namelist()), package)

with tarfile.open(source) as archive:
    names = {name.partition("/")[2] for name in archive.getnames()}
compare(source, names, tracked | {"PKG-INFO"})
