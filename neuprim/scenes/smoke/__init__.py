"""Built-in fluid simulations, for those who have no OpenVDB export at hand.

``scenes`` says what happens, ``solver`` how gas moves (``projection``: incompressibility, ``advection``: transport,
``noise``: turbulence in sources), ``generate`` writes a sequence of OpenVDB files.
"""

from neuprim.scenes.smoke.generate import simulate_smoke
from neuprim.scenes.smoke.scenes import SCENES, SmokeScene

__all__ = ["SCENES", "SmokeScene", "simulate_smoke"]
