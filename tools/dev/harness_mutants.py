"""Faults of the harness that mutations.py plants by name: (file, text with the tokens to replace in «», new, what).

python -m maxq.tools.dev.mutations run --work DIR --mode compiled --named
"""

STATISTICS, LINEAR, WORST = "sim/campaign/statistics.py", "design/verify/linear.py", "design/verify/worst.py"
SUITE, ANALYSIS, DRAWS = "design/verify/suite.py", "sim/campaign/analysis.py", "sim/campaign/draws.py"
PLAN, ROBUST, JUDGING = "sim/campaign/plan.py", "design/optimise/robust.py", "design/verify/judging.py"
SPREAD = "design/model/spread.py"

NAMED = (
    (STATISTICS, "betaincinv(failures + 1, runs - failures, «confidence»)", "1.0 - confidence", "upper bound swapped"),
    (STATISTICS, "betaincinv(failures, runs - failures + 1, «1.0 - confidence»)", "confidence", "lower bound swapped"),
    (STATISTICS, "1.0 - success) <= «1.0 - confidence»)", "confidence", "consumer's risk for its confidence"),
    (STATISTICS, "if runs and «evidence_missed»(failures, runs, p)", "evidence_met", "evidence of the other side"),
    (STATISTICS, ">= -math.log(risks[«0»]):", "1", "risk of the other side"),
    (STATISTICS, "return max(risk - spent[«0»], 1e-300)", "1", "risk that the fixed test has not spent"),
    (STATISTICS, "return bound(«evidence_missed», share", "evidence_met", "bounds of the sequence exchanged"),
    (STATISTICS, "np.where(np.isnan(values), «np.inf»", "-np.inf", "a run without a value counts as the best"),
    (
        STATISTICS,
        "np.partition(worst, len(worst) - 1 - allowed)[len(worst) - «1» - allowed]",
        "2",
        "next order statistic",
    ),
    (STATISTICS, "- _POWER * math.log(p) «-» _log_likelihood", "+", "likelihood ratio turned over"),
    (ANALYSIS, "missed = «~(values <= bound)» if upper", "values > bound", "a run without a value has not missed"),
    (ANALYSIS, "if upper else «~(values >= bound)»", "~(values <= bound)", "least limit inverted"),
    (ANALYSIS, "judge_failures(int(missed«[:n]».sum()), n", "", "runs behind a gap judged"),
    (ANALYSIS, "return np.asarray(~causes «&» ~self.void)", "|", "a run that lost control has kept it"),
    (LINEAR, "np.array([*rows, *[«-np.asarray(r)» for r in rows]], float)", "np.asarray(r)", "mirror corners left out"),
    (LINEAR, "[np.roll(_GENERATOR, k) for k in range(len(_GENERATOR)«»)]", " - 1", "a corner left out"),
    (LINEAR, "np.random.default_rng([seed, «number»])", "0", "seed reused: all vehicles alike"),
    (LINEAR, "np.random.default_rng([«seed», number])", "0", "seed ignored"),
    (LINEAR, ".normal(size=len(factor)) / «3.0»)", "9.0", "three sigma taken as nine"),
    (SPREAD, '"slosh": len(node.vehicle.pendulums.mass_kg)«»}', " - 1", "one tank not dispersed"),
    (SPREAD, '"bending": «len(node.vehicle.modes.omega_radps)»', "1", "higher modes not dispersed"),
    (SPREAD, "size * draw(key, «n»), 0.05) for n, size", "0", "all modes and tanks by the first one's draw"),
    (SPREAD, "values[key] = getattr(spread, key) «*» draw(key, -1)", "* 0.0 *", "delay not dispersed"),
    (LINEAR, "if not found.stable:\n        return {«}»", '"phase_deg": 0.0}', "unstable loop taken for a margin"),
    (LINEAR, "return np.asarray(met.«all»(axis=-1))", "any", "one node met is enough"),
    (LINEAR, "value, where, command = («min» if sense", "max", "best vehicle reported as the worst"),
    (LINEAR, "min(found.aero_gain_db.value, «found.gain_down_db.value»)", "math.inf", "gain margin down left out"),
    (SUITE, "return REJECTED if REJECTED in found else «UNDECIDED» if", "ACCEPTED", "undecided passes"),
    (SUITE, "return «REJECTED» if REJECTED in found", "UNDECIDED", "rejected is undecided"),
    (SUITE, '(value - limit if sense == «"<="»', '">="', "limit inverted"),
    (SUITE, "confidence={1.0 - (1.0 - confidence) «/» designs", "*", "risk not shared"),
    (SUITE, 'out.append(f"{part}.seed={seed «+» number}")', "+ 0 *", "candidates judged by the same draws"),
    (SUITE, 'out = [] if self.campaign else [«"no dispersed flight flown"»]', "", "screening taken for a suite"),
    (WORST, "if value «<» best:", ">", "the best vehicle kept"),
    (WORST, "(loop.closed_poles().real < 0.0).all() else «-»least", "+", "unstable is as far as stable"),
    (WORST, "[farthest(«-»by) for by in slopes]", "+", "search uphill"),
    (WORST, "if found[k] «>» value - 1e-6:", "<", "corner made better"),
    (WORST, "float(frequency) ** «-2»", "2", "scenario with the inverse slosh frequency"),
    (WORST, "ACCEPTED if found.modulus «>=» wanted.modulus", "<=", "limit inverted"),
    (WORST, "exact.modulus if exact.stable else «0.0»", "exact.modulus", "unstable vehicle with its distance"),
    (DRAWS, "cells[inside] = _permutation(seed, key, «hypercube», stratum)", "0", "every hypercube the same"),
    (DRAWS, "np.uint32(hashed & «0xFFFFFFFF»)", "0", "Sobol' points of all inputs scrambled alike"),
    (ROBUST, "at = np.«array»(ends) *", "abs", "deviations to one side only"),
    (ROBUST, "for end in («-1», 0, 1):", "1", "lower ends not searched"),
    (ROBUST, "best = «max»(beginnings, key=score)", "min", "search from the best beginning"),
    (
        PLAN,
        "return uniforms(self.campaign.seed, «d.stream», first, count, attempt)",
        "str(d.entry)",
        "inputs of an entry alike",
    ),
    (PLAN, "new = self._single(d, run, attempt «+ again»)", "", "the same draw again"),
    (JUDGING, "absent = np.isnan(self.values) & «(self.key in PEAKS)»", "True", "unstable loop meets its limits"),
    (JUDGING, 'return self.values - self.limit if self.sense == «">="»', '"<="', "farthest within taken for the worst"),
)
