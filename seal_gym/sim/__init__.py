"""MuJoCo scene, batched physics, sensor renderers."""
