"""Which columns the report prints, under which headings, and how to read them."""

from __future__ import annotations

from ded_bench.report.render import Column

_HEAD = (Column("regime", "Regime"), Column("title", "Method"))
_SPREAD = (("mean", "mean"), ("median", "median"), ("p95", "95 %"), ("max", "max"))

TABLE_V = (
    *_HEAD,
    Column("increase_percent", "% increase in obj. over DED"),
    Column("paper_increase_percent", "paper's %", "g"),
    Column("solve_s", "Sol. time (s)"),
    Column("paper_solve_s", "paper's time (s)", "g"),
    Column("n", "n"),
    Column("failures", "failures"),
    Column("ahead_increase", "objective ahead of paper"),
    Column("ahead_time", "time ahead of paper"),
)
TABLE_VI = (
    *_HEAD,
    Column("freq_violation_hz", "freq. const. viol. (Hz)"),
    Column("paper_freq_violation_hz", "paper's (Hz)", "g"),
    Column("ramp_violation", "ramp const. viol. (pu)"),
    Column("paper_ramp_violation", "paper's (pu)", "g"),
    Column("n", "n"),
    Column("failures", "failures"),
    Column("ahead_frequency", "frequency ahead of paper"),
    Column("ahead_ramp", "ramp ahead of paper"),
)
GAPS = (
    *_HEAD,
    Column("rows", "rows"),
    Column("n", "n"),
    Column("failures", "failures"),
    Column("unpaired", "without DED"),
    *(Column(f"gap_percent_{part}", heading) for part, heading in _SPREAD),
    Column("cost_ratio", "ratio of summed costs", ".6f"),
)
RATES = (
    *_HEAD,
    Column("rows", "rows"),
    Column("success_rate", "success (claimed)", ".1%"),
    Column("correct_rate", "feasible (verified)", ".1%"),
    Column("strict_rate", "strictly feasible (verified)", ".1%"),
)
COVERAGE = (
    *RATES,
    Column("failures", "failures"),
    Column("gap_percent_mean", "gap mean (%)"),
    Column("gap_percent_max", "gap max (%)"),
    Column("freq_violation_hz_mean", "frequency mean (Hz)"),
    Column("freq_violation_hz_max", "frequency max (Hz)"),
)
VIOLATIONS = (
    *_HEAD,
    *(Column(f"freq_violation_hz_{part}", f"frequency {heading} (Hz)") for part, heading in _SPREAD),
    Column("ramp_violation_mean", "ramp mean (pu)"),
    Column("ramp_violation_max", "ramp max"),
    Column("bound_violation_mean", "bounds mean (pu)"),
    Column("bound_violation_max", "bounds max"),
    Column("initial_violation_mean", "initial mean (pu)"),
    Column("initial_violation_max", "initial max"),
)
CLAIMS = (
    *_HEAD,
    Column("status", "status"),
    Column("meaning", "which means"),
    Column("rows", "rows"),
    Column("feasible", "feasible"),
    Column("feasible_strict", "strictly"),
    Column("infeasible", "infeasible"),
    Column("not_scored", "not scored"),
)
_PARTS = (("solve_s", "solve"), ("setup_s", "set-up"), ("build_s", "build"))
_QUARTILES = tuple(
    Column(f"{name}{part}", f"{heading}{mark}")
    for name, heading in _PARTS
    for part, mark in (("_q1", " 25 %"), ("", " median"), ("_q3", " 75 %"))
)
TIMING = (
    *_HEAD,
    Column("instances", "instances"),
    Column("repeats", "repeats"),
    *_QUARTILES,
    Column("first_build_s", "first build"),
    Column("first_setup_s", "first set-up"),
    Column("failures", "failures"),
    Column("load_average", "load"),
    Column("date", "date"),
    Column("error", "error"),
)
LOADED_TIMES = (
    *_HEAD,
    Column("n", "n"),
    Column("workers", "workers"),
    *_QUARTILES,
    Column("solve_s_shifted_geometric_mean", "solve, shifted geometric mean"),
)
WORST = (
    *_HEAD,
    Column("worst_by", "by"),
    Column("instance", "instance"),
    Column("gap_percent", "gap (%)"),
    Column("freq_violation_hz", "frequency (Hz)"),
    Column("ramp_violation", "ramp (pu)"),
    Column("bound_violation", "bounds (pu)"),
    Column("initial_violation", "initial (pu)"),
    Column("excess", "× tolerance"),
)
STARTS = (
    Column("regime", "Regime"),
    Column("start", "starting point"),
    Column("n", "n"),
    Column("same", "the same optimum"),
    Column("lowest_percent", "lowest change (%)"),
    Column("highest_percent", "highest change (%)"),
    Column("iterations", "iterations, median"),
    Column("iterations_cold", "of the cold start"),
)
TRAINING = (
    Column("policy", "Policy"),
    Column("seconds", "seconds"),
    Column("epochs", "epochs"),
    Column("instances", "instances"),
    Column("held_out", "held out"),
    Column("held_out_loss", "held-out loss", ".6g"),
    Column("parameters", "parameters"),
    Column("model", "Koopman model"),
    Column("seed", "seed"),
    Column("device", "device"),
    Column("torch", "torch"),
    Column("problem", "problem"),
)
MODELS = (
    Column("regime", "Regime"),
    Column("title", "Method"),
    Column("model", "Koopman model"),
    Column("n", "n"),
    Column("failures", "failures"),
    *(Column(f"gap_percent_{part}", f"gap {heading} (%)") for part, heading in _SPREAD),
    Column("freq_violation_hz_mean", "frequency mean (Hz)"),
    Column("freq_violation_hz_max", "frequency max (Hz)"),
)
ABLATION = (
    Column("regime", "Regime"),
    Column("change", "what differs"),
    Column("n", "n"),
    *(Column(f"gap_percent_{part}", f"gap {heading} (%)") for part, heading in _SPREAD if part != "median"),
    Column("freq_violation_hz_mean", "frequency mean (Hz)"),
    Column("freq_violation_hz_max", "frequency max (Hz)"),
    Column("seconds", "training (s)"),
    Column("epochs", "epochs"),
    Column("steps", "steps"),
    Column("instances", "instances"),
    Column("parameters", "parameters"),
)
CERTIFICATE = (
    *_HEAD,
    Column("count", "instances"),
    Column("successes", "successes"),
    Column("meets_limits", "meet every limit"),
    Column("near_reference", "within the gap"),
    Column("clopper_pearson", "Clopper–Pearson", ".2%"),
    Column("hoeffding", "Hoeffding", ".2%"),
    Column("tolerance_hz", "tolerance (Hz)"),
    Column("tolerance_pu", "tolerance (pu)"),
    Column("gap_percent", "gap (%)"),
    Column("reference", "gap over"),
    Column("delta", "δ"),
    Column("seed", "master seed"),
    Column("artifacts", "case, policy and models"),
    Column("host", "host"),
    Column("date", "date"),
)

EXPLANATION = (
    "**Objective and violations are re-simulated**: every schedule is integrated on the true swing "
    "equations, whatever its solver claimed. The increase is the mean of the signed 100·(J / J_DED − 1) over "
    "the `n` instances where both have a score; violations are means of each instance's maximum over time "
    "and generators.",
    "**Failures** are rows without a schedule or a score. They enter no mean, and a method with failures is "
    "never ahead of the paper.",
    "**Ahead of paper** compares our number with the paper's: yes if below, equal if the same. The paper's "
    "times are from another machine, and its instances are other draws from the same ranges.",
    "**DED's optima are local**: the problem is not convex, so a method may come out below zero; DED also "
    "breaks the tight frequency bound slightly, since backward Euler is not exact.",
    "**Success** is what a method claims, **feasible** what the scorer found: frequency within 1e-4 Hz, "
    "power limits within 1e-6 pu (strictly: 1e-6 Hz and 1e-8 pu).",
    "**The ratio of summed costs** is ΣJ / ΣJ_DED over the same `n` instances: dear instances weigh more in "
    "it than in the mean of the gaps.",
    "**Solution times** are those of `ded-bench bench` alone on one machine; times of the results table were "
    "taken while several workers shared the machine and stand in the details only.",
)
