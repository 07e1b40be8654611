"""Time all engines on the same problems, after checking that they agree.

python scripts/benchmark.py
python scripts/benchmark.py benchmark.shapes=[stress] benchmark.repeats=3
python scripts/benchmark.py benchmark.shapes=[paper] benchmark.engines=[odeint,fused_1]
"""

from nnode.app.benchmark import benchmark
from nnode.app.cli import run

if __name__ == "__main__":
    run("benchmark", benchmark)
