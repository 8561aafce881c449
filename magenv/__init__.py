"""magenv: a Gymnasium environment of two magnetic robots under external permanent magnets.

Importing the package registers ``magenv/TwoRobots-v0``.
"""

from gymnasium.envs.registration import register, registry

__version__ = "0.1.0"
ENV_ID = "magenv/TwoRobots-v0"

if ENV_ID not in registry:
    register(
        id=ENV_ID,
        entry_point="magenv.env:TwoRobots",
        vector_entry_point="magenv.vector_env:TwoRobotsVector",
        order_enforce=False,  # the environment itself refuses what comes before ``reset``
    )

__all__ = ["ENV_ID", "__version__"]
