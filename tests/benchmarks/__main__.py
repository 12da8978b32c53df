"""All speed figures: ``python -m tests.benchmarks``; the soak runs apart, ``...benchmarks.soak``."""

from tests.benchmarks import bench_envs, bench_ik, bench_raycast, bench_rmp, bench_vision

for bench in (bench_rmp, bench_ik, bench_raycast, bench_vision, bench_envs):
    print(f"\n{bench.__doc__.splitlines()[0]}")
    bench.main()
