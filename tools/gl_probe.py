"""Renders one picture with MuJoCo's OpenGL: exit status 0 if that works, else 1 and the reason on stderr.

A process of its own, because a broken driver may crash, and because MuJoCo chooses its backend
(``MUJOCO_GL``, here ``egl`` unless set) once, when it is imported. Prints the backend that works.
"""

import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")


def main() -> int:
    """Tries to render and says how it went."""
    try:
        import mujoco

        model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/></worldbody></mujoco>")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        with mujoco.Renderer(model, height=8, width=8) as renderer:
            renderer.update_scene(data)
            renderer.render()
    except Exception as error:  # whatever fails, there is no OpenGL
        print(f"{type(error).__name__}: {error}".splitlines()[0], file=sys.stderr)
        return 1
    print(os.environ["MUJOCO_GL"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
