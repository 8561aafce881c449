"""Controllers for magenv: the paper's, and learned ones, behind one ``predict``."""

from agents.baseline import Baseline
from agents.learned import Learned

__all__ = ["Baseline", "Learned"]
