# SPDX-License-Identifier: Apache-2.0
"""``make fuzz``: gives all readers thousands of damaged and hostile inputs.

python -m tests.fuzz --inputs 10000 --seed 0 --keep fuzz
python -m tests.fuzz --seed 0 --only 1234       one again, with what was said
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from .run import fuzz, one


def main() -> int:
    """Run the fuzzer and print what it found; return 1 if it found something."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--keep", type=Path, default=Path("fuzz-findings"), help="where inputs of findings go"
    )
    parser.add_argument("--only", type=int, help="number of one input to run again")
    parser.add_argument("--kinds", default="", help="only kinds with one of these in their name: csv,ckpt")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.only is not None:
        verdict = one(arguments.only, seed=arguments.seed, keep=arguments.keep, names=arguments.kinds)
        sys.stdout.write(f"{verdict}\n{verdict.said}\n")
        return int(bool(verdict.finding))
    result = fuzz(
        arguments.inputs,
        seed=arguments.seed,
        keep=arguments.keep,
        names=arguments.kinds,
        processes=arguments.processes,
        first=arguments.first,
    )
    by_finding = Counter((verdict.name, verdict.finding) for verdict in result.findings)
    for (name, finding), count in by_finding.most_common():
        example = next(v.number for v in result.findings if (v.name, v.finding) == (name, finding))
        sys.stdout.write(f"{count:5d} × {name}: {finding} (e.g. {example})\n")
    sys.stdout.write(f"{result}\n")
    return int(bool(result.findings))


if __name__ == "__main__":
    sys.exit(main())
