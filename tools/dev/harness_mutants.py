"""Faults of the harness that mutations.py plants by name: (file, text with the tokens to replace in «», new, what).

python -m maxq.tools.dev.mutations plant --work DIR --number 0 --named, then map and run
"""

STATISTICS, LINEAR, WORST = "sim/campaign/statistics.py", "design/verify/linear.py", "design/verify/worst.py"
QUANTITIES = "design/quantities.py"
SUITE, ANALYSIS, DRAWS = "design/verify/suite.py", "sim/campaign/analysis.py", "sim/campaign/draws.py"
PLAN, ROBUST, JUDGING = "sim/campaign/plan.py", "design/optimise/robust.py", "design/verify/judging.py"
SPREAD, RARE = "design/model/spread.py", "sim/campaign/rare.py"
DEVIATIONS = "design/model/deviations.py"
MU, MONTHS, SOUNDINGS = "design/verify/named_mu.py", "sim/campaign/availability.py", "sim/scenario/soundings.py"
FLOWN, ALLOCATION = "design/verify/flown.py", "sim/vehicle/engine/allocation.py"

NAMED = (
    (STATISTICS, "betaincinv(failures + 1, runs - failures, «confidence»)", "1.0 - confidence", "upper bound swapped"),
    (STATISTICS, "betaincinv(failures, runs - failures + 1, «1.0 - confidence»)", "confidence", "lower bound swapped"),
    (STATISTICS, "bool(bdtr(k, runs, p) > «risk»)", "confidence", "consumer's risk for its confidence"),
    (STATISTICS, "if runs and «evidence_missed»(failures, runs, p)", "evidence_met", "evidence of the other side"),
    (STATISTICS, ">= -math.log(«risk_met»):", "risk_missed", "risk of the other side"),
    (
        STATISTICS,
        "max(risk - «(float(bdtr(allowed, planned, p)) if allowed >= 0 else 0.0)», 1e-300)",
        "0.0",
        "risk that the fixed test has not spent",
    ),
    (STATISTICS, "return bound(«evidence_missed», 1e-12)", "evidence_met", "bounds of the sequence exchanged"),
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
    (DEVIATIONS, "np.random.default_rng([seed, «n»])", "0", "seed reused: all vehicles alike"),
    (DEVIATIONS, "np.random.default_rng([«seed», n])", "0", "seed ignored"),
    (DEVIATIONS, ".normal(size=len(factor)) / «3.0»", "9.0", "three sigma taken as nine"),
    (DEVIATIONS, "found = plan.draw(numbers.«start», len(numbers))", "stop", "other runs than those of the campaign"),
    (DEVIATIONS, 'Rule("slosh_frequency", «-0.5»)', "0.5", "longer pendulums swing faster"),
    (
        DEVIATIONS,
        "first = sum(each.pendulums for each in stage.tank[:«tank»])",
        "0",
        "every tank by the first one's draw",
    ),
    (DEVIATIONS, "section = «5 - section»", "section", "pole and zero not exchanged"),
    (SPREAD, '"slosh": len(vehicle.pendulums.mass_kg)«»}', " - 1", "one tank not dispersed"),
    (SPREAD, '"bending": «len(vehicle.omega_radps)»', "1", "higher modes not dispersed"),
    (SPREAD, "by = [size * draw(key, «n») for size, n", "0", "all modes and tanks by the first one's draw"),
    (LINEAR, "if found.margins.stable else {«}»", '"rigid_phase_deg": 0.0}', "unstable loop taken for a margin"),
    (LINEAR, "return np.asarray(met.«all»(axis=-1))", "any", "one node met is enough"),
    (LINEAR, "value, limit, where, command = «max»(rows", "min", "best vehicle reported as the worst"),
    (SUITE, "return REJECTED if REJECTED in found else «UNDECIDED» if", "ACCEPTED", "undecided passes"),
    (SUITE, "return «REJECTED» if REJECTED in found", "UNDECIDED", "rejected is undecided"),
    (QUANTITIES, '(value - limit if sense == «"<="»', '">="', "limit inverted"),
    (QUANTITIES, "j.margins.gain_«down»_db.value", "up", "lower gain margin left out"),
    (SUITE, "confidence={1.0 - (1.0 - confidence) «/» designs", "*", "risk not shared"),
    (SUITE, 'out.append(f"{part}.seed={seed «+» number}")', "+ 0 *", "candidates judged by the same draws"),
    (SUITE, 'out = [] if self.campaign else [«"no dispersed flight flown"»]', "", "screening taken for a suite"),
    (WORST, "if value «<» best:", ">", "the best vehicle kept"),
    (WORST, "return «-»least if growing_count(", "+", "unstable is as far as stable"),
    (WORST, "[region.farthest(«-»by) for by in slopes]", "+", "search uphill"),
    (WORST, "if found[k] «>» value - 1e-6:", "<", "corner made better"),
    (SPREAD, 'length_factor",), power=«-2.0»)', "2.0", "scenario with the inverse slosh frequency"),
    (SPREAD, "vectors * np.sqrt(np.maximum(sizes, 0.0))) @ vectors.«T»", "conj()", "root of the correlations turned"),
    (DEVIATIONS, "self.places, «self._root» @ u, label", "np.eye(len(u))", "scores without correlations"),
    (RARE, "p *= «len(beyond)» / n", "chains - 1", "conditional probability one chain short"),
    (RARE, "math.sqrt(1.0 - step_size**2) * z «+»", "* 1.1 +", "chains leave the distribution"),
    (RARE, "there > «level»", "-np.inf", "chains that leave their level"),
    (RARE, "found = «sign» * (row.metrics[metric] - limit)", "-sign", "limit inverted"),
    (WORST, "ACCEPTED if found.modulus «>=» wanted.modulus", "<=", "limit inverted"),
    (WORST, "exact.modulus if exact.stable else «0.0»", "exact.modulus", "unstable vehicle with its distance"),
    (DRAWS, "cells[inside] = _permutation(seed, key, «hypercube», stratum)", "0", "every hypercube the same"),
    (DRAWS, "np.uint32(hashed & «0xFFFFFFFF»)", "0", "Sobol' points of all inputs scrambled alike"),
    (ROBUST, "at(np.«array»(ends) *", "abs", "deviations to one side only"),
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
    (MU, "np.block([[s * np.eye(n) - a, «-»b]", "+", "loops closed with the other sign"),
    (MU, "driven[n + k «%» m, column]", "//", "delay of one command only"),
    (MONTHS, "each = 0.5 * (1.0 «+» confidence)", "-", "bounds of another confidence"),
    (MONTHS, "bad = mine[«~»passed[mine]]", "", "flights that pass counted as missed"),
    (PLAN, 'months[«"sigma_factor"»][row', '"mean_factor"', "deviations scaled as the mean"),
    (PLAN, "(np.arange(first, first + count) «%» len(self._months)", "//", "months not in turn"),
    (SOUNDINGS, 'f"{head[1]}-{head[«2»]}-', "3", "day taken for the month"),
    (FLOWN, "month.judged(«wanted», result", "result.success", "availability asked at the campaign's own level"),
    (
        ALLOCATION,
        "strength = «float»(engine",
        "engine.thrust_factor * float",
        "computer knows what an engine deviates by",
    ),
    (WORST, "drift_radps = 2.0 * np.pi * «lowest_hz_of(np.asarray(loop.open_poles()))»", "0.0", "drift is unstable"),
    (
        JUDGING,
        'margin = self.values - self.limit if self.sense == «">="»',
        '"<="',
        "farthest within taken for the worst",
    ),
)
