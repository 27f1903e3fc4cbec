"""Suites of runs: scenes x methods x rates x seeds from one file, run here or on a cluster, in the paper's tables.

```text
suite.py     what a suite is, read from TOML           shipped/     suites of the field's data sets
jobs.py      its runs, one `compgs train` each         serial.py    one after the other
child.py     the process of one run                    cluster.py   on the machines of a Ray cluster
results.py   tables, report, the survey's files        benchmark.py all of it, in order
```
"""

from compgs.suites.benchmark import Benchmark, benchmark
from compgs.suites.suite import SHIPPED, Suite, load_suite

__all__ = ["SHIPPED", "Benchmark", "Suite", "benchmark", "load_suite"]
