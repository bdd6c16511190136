"""Deliberate errors, and whether the tests find them.

`python tests/mutants.py [NAME ...]` applies each to a copy of the package, runs a
sample of the rows of the catalogue that have the entries it concerns, and prints found
or missed. An error is found if a test fails. What is not part of a pair, as a potential
or a diagnostic, is looked for by the tests that an error names.
"""

import argparse
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

from deliberate_errors import Mutant, MUTANTS


ROOT = pathlib.Path(__file__).parents[1]


def found(mutant: Mutant, rows: int) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder)
        for part in ("diffrax_presym", "tests"):
            shutil.copytree(ROOT / part, copy / part)
        shutil.copytree(ROOT / "docs", copy / "docs")
        shutil.copy(ROOT / "pyproject.toml", copy)
        path = copy / "diffrax_presym" / mutant.file
        text = path.read_text()
        assert mutant.old in text, f"{mutant.name}: not found in {mutant.file}"
        path.write_text(text.replace(mutant.old, mutant.new))
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "2"]
        command += ["-p", "no:cacheprovider", f"tests/{mutant.tests}"]
        sampled = mutant.tests in ("test_pairs.py", "test_refusals.py")
        command += ["-m", "not slow"] if sampled else []
        command += ["-k", mutant.only] if mutant.only else []
        environment = os.environ | {"PYTHONPATH": folder, "ROWS": str(rows)}
        environment["ENTRIES"] = "|".join(mutant.of)
        run = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True
        )
        # Where the first failure ends a run of several processes, the status is 2.
        failed, passed = (word in run.stdout for word in ("FAILED tests", "passed in"))
        if not failed and (run.returncode or not passed):
            raise RuntimeError(f"The tests did not run:\n{run.stdout[-2000:]}")
        return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="words in the names of some of them")
    parser.add_argument("--rows", type=int, default=24, help="the size of the sample")
    options = parser.parse_args()
    number = 0
    chosen = [
        mutant
        for mutant in MUTANTS
        if not options.names or any(word in mutant.name for word in options.names)
    ]
    for mutant in chosen:
        right = found(mutant, options.rows)
        number += right
        print(f"{'found ' if right else 'MISSED'} {mutant.name}", flush=True)
    print(f"{number} of {len(chosen)} found")


if __name__ == "__main__":
    main()
