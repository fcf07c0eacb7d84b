"""How exactly schedules of `ded-slp` keep the frequency bound, and when a sequence of programs ends."""

from __future__ import annotations

import numpy as np

#: Programs keep this much below the bound, and may leave half of it open between the points that have
#: rows: the rest absorbs the model's error of the last program. A schedule is accepted if its simulation
#: exceeds the bound by at most half of what strict feasibility allows (1e-6 Hz). Costs are 1e-6 higher.
MARGIN = 2 * np.pi * 1e-6
OPEN = ACCEPTED = 2 * np.pi * 5e-7
#: Around a trajectory that exceeds the bound, rows are added until this part of its excess is left: the
#: model's error is no smaller, and another trajectory is cheaper than another program. Around the first one
#: a single program is solved, unless it comes from an earlier solution.
REFINEMENT = 0.01
#: Agreement of a simulated schedule's cost with its program's, as a fraction.
COST_TOLERANCE = 1e-6
