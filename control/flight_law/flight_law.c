#include "flight_law.h"

#include "flight_law_tables.h"

/* Products and sums are rounded one by one, so that every compiler gives the same bits. */
#if !defined(__GNUC__) || defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

#define REAL(number) ((law_real)(number))

static law_real limited(law_real value, law_real limit)
{
    law_real out = value;
    if (out < -limit) {
        out = -limit;
    }
    if (out > limit) {
        out = limit;
    }
    return out;
}

/* What a stage's gains are scheduled over. */
static law_real scheduled(const law_stage *of, const law_inputs *in)
{
    law_real at = in->time_s;
    if (of->over == 1) {
        at = in->speed_mps;
    } else if (of->over == 2) {
        at = in->mass_kg;
    } else if (of->over == 3) {
        at = in->dynamic_pressure_Pa;
    } else {
        /* the time */
    }
    return at;
}

/* The place among rising breakpoints, clamped: the interval, and the distance from its start. */
static int32_t interval(const law_real *breaks, int32_t count, law_real at, law_real *distance)
{
    law_real inside = at;
    int32_t low = 0;
    int32_t high = count - 1;
    if (inside < breaks[0]) {
        inside = breaks[0];
    }
    if (inside > breaks[high]) {
        inside = breaks[high];
    }
    while (high - low > 1) {
        const int32_t middle = (low + high) / 2;
        if (breaks[middle] <= at) {
            low = middle;
        } else {
            high = middle;
        }
    }
    *distance = inside - breaks[low];
    return low;
}

/* Gains: k_p, k_d_s and a third, k_i_ps, k_a_s2pm or k_alpha (with what the incidence is estimated with), in pitch, then
 * in yaw. Cubics, end values outside. */
static void look_up(const law_stage *of, law_real at, law_real gains[2 * LAW_GAINS])
{
    law_real s;
    const int32_t low = interval(of->gain_at, of->gain_breaks, at, &s);
    int32_t column;
    for (column = 0; column < (2 * LAW_GAINS); ++column) {
        const law_real c0 = of->gain[low][0][column];
        const law_real c1 = of->gain[low][1][column];
        const law_real c2 = of->gain[low][2][column];
        const law_real c3 = of->gain[low][3][column];
        gains[column] = c0 + s * (c1 + s * (c2 + s * c3));
    }
}

/* Second-order sections (b0, b1, b2, a1, a2) in transposed direct form II. */
static law_real filtered(
    int32_t sections, const law_real (*of)[5], law_real memory[LAW_MOST_SECTIONS][2], law_real input)
{
    law_real value = input;
    int32_t i;
    for (i = 0; i < sections; ++i) {
        const law_real *const section = of[i];
        const law_real out = section[0] * value + memory[i][0];
        memory[i][0] = section[1] * value - section[3] * out + memory[i][1];
        memory[i][1] = section[2] * value - section[4] * out;
        value = out;
    }
    return value;
}

/* The filter as it is after a long time at one input. */
static void settled(
    int32_t sections, const law_real (*of)[5], law_real memory[LAW_MOST_SECTIONS][2], law_real input)
{
    law_real value = input;
    int32_t i;
    for (i = 0; i < sections; ++i) {
        const law_real *const section = of[i];
        const law_real out = value * (section[0] + section[1] + section[2]) / (REAL(1.0) + section[3] + section[4]);
        memory[i][1] = section[2] * value - section[4] * out;
        memory[i][0] = section[1] * value - section[3] * out + memory[i][1];
        value = out;
    }
}

#if LAW_MOVING_FILTER == 1
/* The frequencies (Hz) and damping ratios of a bending filter that changes, linear between the points. */
static void move_filter(const law_stage *of, law_state *state, law_real at)
{
    law_real s;
    const int32_t low = interval(of->filter_at, of->filter_breaks, at, &s);
    int32_t k;
    for (k = 0; k < LAW_FILTER_PARAMETERS; ++k) {
        state->filter_parameter[k] = of->filter_table[low][0][k] + s * of->filter_table[low][1][k];
    }
}

/* State-variable section: zero_hz, zero_zeta, pole_hz, pole_zeta. */
static law_real quadratic(const law_real *p, law_real g_per_hz, law_real memory[2], law_real value)
{
    const law_real g = p[2] * g_per_hz;
    const law_real r = p[2] / p[0];
    const law_real damping = REAL(2.0) * p[3];
    const law_real x1 = (memory[0] + g * (value - memory[1])) / (REAL(1.0) + g * (damping + g));
    const law_real x2 = memory[1] + g * x1;
    const law_real e = value - damping * x1 - x2;
    memory[0] = REAL(2.0) * x1 - memory[0];
    memory[1] = REAL(2.0) * x2 - memory[1];
    return r * r * e + REAL(2.0) * p[1] * r * x1 + x2;
}

/* zero_hz, pole_hz. */
static law_real first_order(const law_real *p, law_real g_per_hz, law_real memory[2], law_real value)
{
    const law_real g = p[1] * g_per_hz;
    const law_real r = p[1] / p[0];
    const law_real x = memory[0] + g * (value - memory[0]) / (REAL(1.0) + g);
    memory[0] = REAL(2.0) * x - memory[0];
    return x + r * (value - x);
}

static law_real moved(const law_stage *of, law_state *state, int32_t axis, law_real input)
{
    const law_real *p = state->filter_parameter;
    law_real value = input;
    int32_t i;
    for (i = 0; i < of->filter_quadratic; ++i) {
        value = quadratic(p, of->filter_g_per_hz, state->moving[axis][i], value);
        p = &p[4];
    }
    for (i = of->filter_quadratic; i < of->filter_quadratic + of->filter_first_order; ++i) {
        value = first_order(p, of->filter_g_per_hz, state->moving[axis][i], value);
        p = &p[2];
    }
    return value;
}

/* The integrators as they are after a long time at one input. */
static void settle_moved(const law_stage *of, law_state *state, int32_t axis, law_real input)
{
    int32_t i;
    for (i = 0; i < of->filter_quadratic + of->filter_first_order; ++i) {
        law_real *const own = state->moving[axis][i];
        own[0] = input;
        own[1] = REAL(0.0);
        if (i < of->filter_quadratic) {
            own[0] = REAL(0.0);
            own[1] = input;
        }
    }
}
#endif

#if (LAW_MOVING_FILTER == 1) && (LAW_LOOP_FILTERS == 1)
/* The present filter as second-order sections with their memory, which go on with the same output. */
static void freeze(const law_stage *of, law_state *state, int32_t axis)
{
    const law_real *p = state->filter_parameter;
    int32_t i;
    for (i = 0; i < of->filter_quadratic + of->filter_first_order; ++i) {
        law_real *const own = state->moving[axis][i];
        law_real *const row = state->frozen[axis][i];
        law_real y0;
        law_real y1;
        if (i < of->filter_quadratic) {
            const law_real g = p[2] * of->filter_g_per_hz;
            const law_real r = p[2] / p[0];
            const law_real zero = REAL(2.0) * p[1] * r * g;
            const law_real pole = REAL(2.0) * p[3] * g;
            const law_real a0 = REAL(1.0) + pole + g * g;
            row[0] = (r * r + zero + g * g) / a0;
            row[1] = REAL(2.0) * (g * g - r * r) / a0;
            row[2] = (r * r - zero + g * g) / a0;
            row[3] = REAL(2.0) * (g * g - REAL(1.0)) / a0;
            row[4] = (REAL(1.0) - pole + g * g) / a0;
            y0 = quadratic(p, of->filter_g_per_hz, own, REAL(0.0));
            y1 = quadratic(p, of->filter_g_per_hz, own, REAL(0.0));
            p = &p[4];
        } else {
            const law_real g = p[1] * of->filter_g_per_hz;
            const law_real r = p[1] / p[0];
            row[0] = (g + r) / (REAL(1.0) + g);
            row[1] = (g - r) / (REAL(1.0) + g);
            row[2] = REAL(0.0);
            row[3] = (g - REAL(1.0)) / (REAL(1.0) + g);
            row[4] = REAL(0.0);
            y0 = first_order(p, of->filter_g_per_hz, own, REAL(0.0));
            y1 = first_order(p, of->filter_g_per_hz, own, REAL(0.0));
            p = &p[2];
        }
        state->old_filter[3][axis][i][0] = y0;
        state->old_filter[3][axis][i][1] = y1 + row[3] * y0;
    }
}
#endif

#if LAW_LOOP_FILTERS == 1
/* What filter `bank` (0 to 2: attitude error, rate, acceleration; 3: the bending filter) of the stage before gives for the
 * same input, fading out beside that of the new one. */
static law_real faded(const law_stage *of, law_state *state, int32_t bank, int32_t axis, law_real input, law_real out)
{
    const law_stage *const before = &law_stages[state->old_stage];
    law_real mixed = out;
    if (state->fading > 0) {
        int32_t sections = (bank == 3) ? before->sections[axis] : before->loop_sections[bank];
        const law_real (*old_filter)[5] = (bank == 3) ? before->section[axis] : before->loop_section[bank];
        law_real old;
#if LAW_MOVING_FILTER == 1
        if ((bank == 3) && (before->filter_breaks != 0)) {
            sections = before->filter_quadratic + before->filter_first_order;
            old_filter = (const law_real (*)[5])state->frozen[axis];
        }
#endif
        old = filtered(sections, old_filter, state->old_filter[bank][axis], input);
        mixed = out + (law_real)state->fading / ((law_real)of->fade_ticks + REAL(1.0)) * (old - out);
    }
    return mixed;
}

/* What the law works on in place of a measurement. */
static law_real loop_filtered(const law_stage *of, law_state *state, int32_t bank, int32_t axis, law_real input)
{
    law_real out = input;
    state->loop_input[bank][axis] = input;
    if ((of->loop_filters != 0) || (state->fading > 0)) {
        out = filtered(of->loop_sections[bank], of->loop_section[bank], state->loop_filter[bank][axis], input);
        out = faded(of, state, bank, axis, input, out);
    }
    return out;
}

/* A separation: the filters of the stage before are kept to fade out, the loops' own of the new one start settled. */
static void fade(const law_stage *of, law_state *state, int32_t axis)
{
    int32_t bank;
    int32_t i;
    for (bank = 0; bank < 4; ++bank) {
        for (i = 0; i < LAW_MOST_SECTIONS; ++i) {
            const law_real *const memory =
                (bank == 3) ? state->filter[axis][i] : state->loop_filter[bank][axis][i];
            state->old_filter[bank][axis][i][0] = memory[0];
            state->old_filter[bank][axis][i][1] = memory[1];
        }
    }
#if LAW_MOVING_FILTER == 1
    if (law_stages[state->old_stage].filter_breaks != 0) {
        freeze(&law_stages[state->old_stage], state, axis);
    }
#endif
    for (bank = 0; bank < 3; ++bank) {
        settled(
            of->loop_sections[bank], of->loop_section[bank], state->loop_filter[bank][axis],
            state->loop_input[bank][axis]);
    }
}
#endif

/* Limit, then the nearest step of the output converter that is not beyond it; halves away from zero. */
static law_real converted(const law_stage *of, law_real requested_rad, int64_t *steps)
{
    const law_real step_rad = of->dac_step_rad;
    const law_real limit_rad = of->command_limit_rad;
    law_real command_rad = limited(requested_rad, limit_rad);
    *steps = 0;
    if (step_rad > REAL(0.0)) {
        const law_real ratio = command_rad / step_rad;
        law_real size_rad;
        *steps = (int64_t)(ratio + ((ratio < REAL(0.0)) ? REAL(-0.5) : REAL(0.5)));
        size_rad = ((*steps < 0) ? -(law_real)*steps : (law_real)*steps) * step_rad;
        if (size_rad > limit_rad * REAL(1.0 + 1.0e-12)) {
            *steps += (*steps > 0) ? -1 : 1;
        }
        command_rad = (law_real)*steps * step_rad;
    }
    return command_rad;
}

/* Switching line with dead band, hysteresis and a shortest firing; a positive s demands a negative torque. Axis 0 is roll,
 * 1 and 2 are pitch and yaw in a coast. */
static int32_t fire(const law_stage *of, law_state *state, int32_t axis, law_real error_rad, law_real rate_radps)
{
    const law_real s = error_rad + of->roll_k_rate_s * rate_radps;
    const law_real on_rad = of->roll_dead_band_rad;
    const law_real off_rad = on_rad - of->roll_hysteresis_rad;
    const int32_t before = state->thruster[axis];
    int32_t demand = 0;
    if ((before != 0) && (state->ticks_on[axis] < of->roll_shortest_ticks)) {
        demand = before;
    } else if ((s > on_rad) || ((before < 0) && (s > off_rad))) {
        demand = -1;
    } else if ((s < -on_rad) || ((before > 0) && (s < -off_rad))) {
        demand = 1;
    }
    if (demand == 0) {
        state->ticks_on[axis] = 0;
    } else if (demand == before) {
        state->ticks_on[axis] += 1;
    } else {
        state->ticks_on[axis] = 1;
    }
    state->thruster[axis] = demand;
    return demand;
}

static void silence(law_state *state, int32_t axis)
{
    state->thruster[axis] = 0;
    state->ticks_on[axis] = 0;
}

#if LAW_ADAPTIVE == 1
/* Total gain 1; the reference model begins at the first sample's error and rate. */
static void start_adapting(const law_stage *of, law_state *state)
{
    int32_t axis;
    for (axis = 0; axis < 2; ++axis) {
        state->adapts[axis] = 0;
        state->added_gain[axis] = REAL(1.0) - of->adaptive_least;
        state->total_gain[axis] = REAL(1.0);
        state->damper_rad2[axis] = REAL(0.0);
        state->high_pass[axis][0] = REAL(0.0);
        state->high_pass[axis][1] = REAL(0.0);
    }
}

/* Adaptive augmenting control: the command times the total gain. Raised by an error beyond the reference model's,
 * lowered by the command's content above the high-pass, drawn back to 1. */
static law_real augmented(
    const law_stage *of, law_state *state, int32_t axis, law_real error_rad, law_real rate_radps,
    law_real commanded_radps, law_real law_rad)
{
    law_real *const at = state->reference[axis];
    law_real *const memory = state->high_pass[axis];
    const law_real span = of->adaptive_span;
    const law_real *const section = of->adaptive_high_pass; /* b0, b1, b2, a1, a2 */
    law_real k_a = state->added_gain[axis];
    law_real e_r;
    law_real raised;
    law_real lowered;
    law_real command_rad;
    law_real high_rad;
    if (state->adapts[axis] == 0) {
        state->adapts[axis] = 1;
        at[0] = error_rad;
        at[1] = rate_radps;
    } else {
        const law_real (*const step)[3] = of->adaptive_reference;
        const law_real model_rad = step[0][0] * at[0] + step[0][1] * at[1] + step[0][2] * commanded_radps;
        at[1] = step[1][0] * at[0] + step[1][1] * at[1] + step[1][2] * commanded_radps;
        at[0] = model_rad;
    }
    e_r = error_rad - at[0];
    raised = of->adaptive_error_gain * (span - k_a) / span * (e_r * e_r);
    lowered = of->adaptive_damper_gain * k_a * state->damper_rad2[axis]
        + of->adaptive_leakage_ps * (state->total_gain[axis] - REAL(1.0));
    k_a = k_a + of->sample_s * (raised - lowered);
    if (k_a < REAL(0.0)) {
        k_a = REAL(0.0);
    }
    if (k_a > span) {
        k_a = span;
    }
    state->added_gain[axis] = k_a;
    state->total_gain[axis] = of->adaptive_least + k_a;
    command_rad = state->total_gain[axis] * law_rad;
    high_rad = section[0] * command_rad + memory[0];
    memory[0] = section[1] * command_rad - section[3] * high_rad + memory[1];
    memory[1] = section[2] * command_rad - section[4] * high_rad;
    state->damper_rad2[axis] += of->adaptive_low_pass_share * (high_rad * high_rad - state->damper_rad2[axis]);
    return command_rad;
}
#endif

/* The stage that flies now; one with a law or timing of its own begins with settled filters and idle thrusters. */
static const law_stage *flying(law_state *state, int32_t stage)
{
    while ((state->stage < stage) && (state->stage < LAW_STAGES - 1)) {
        state->stage += 1;
        if (law_stages[state->stage].takes_over != 0) {
            const law_stage *const of = &law_stages[state->stage];
            int32_t axis;
#if LAW_LOOP_FILTERS == 1
            state->fading = of->fade_ticks;
            state->old_stage = state->stage - 1;
#endif
            for (axis = 0; axis < 2; ++axis) {
#if LAW_LOOP_FILTERS == 1
                fade(of, state, axis);
#endif
                settled(of->sections[axis], of->section[axis], state->filter[axis], state->law_rad[axis]);
#if LAW_MOVING_FILTER == 1
                settle_moved(of, state, axis, state->law_rad[axis]);
#endif
            }
            silence(state, 0);
#if LAW_ADAPTIVE == 1
            start_adapting(of, state);
#endif
        }
    }
    return &law_stages[state->stage];
}

void law_start(law_state *state)
{
    int32_t axis;
    int32_t bank;
    int32_t i;
    for (axis = 0; axis < 3; ++axis) {
        state->total_counts[axis] = 0;
        state->angle_rad[axis] = REAL(0.0);
        silence(state, axis);
    }
    for (axis = 0; axis < 2; ++axis) {
        state->integral_rad[axis] = REAL(0.0);
        state->law_rad[axis] = REAL(0.0);
        state->requested_rad[axis] = REAL(0.0);
        state->accel_mps2[axis] = REAL(0.0);
        state->rate_radps[axis] = REAL(0.0);
        state->drift_mps[axis] = REAL(0.0);
        state->drift_m[axis] = REAL(0.0);
        for (i = 0; i < LAW_MOST_SECTIONS; ++i) {
            state->moving[axis][i][0] = REAL(0.0);
            state->moving[axis][i][1] = REAL(0.0);
            state->filter[axis][i][0] = REAL(0.0);
            state->filter[axis][i][1] = REAL(0.0);
            for (bank = 0; bank < 3; ++bank) {
                state->loop_filter[bank][axis][i][0] = REAL(0.0);
                state->loop_filter[bank][axis][i][1] = REAL(0.0);
            }
        }
        for (bank = 0; bank < 3; ++bank) {
            state->loop_input[bank][axis] = REAL(0.0);
        }
    }
    for (i = 0; i < 4 * LAW_MOST_SECTIONS; ++i) {
        state->filter_parameter[i] = REAL(1.0);
    }
    state->stage = 0;
    state->fading = 0;
    state->old_stage = 0;
#if LAW_ADAPTIVE == 1
    start_adapting(&law_stages[0], state);
#endif
}

void law_step(law_state *state, const law_inputs *in, law_outputs *out)
{
    const law_stage *const of = flying(state, in->stage);
    law_real gains[2 * LAW_GAINS];
    law_real error_rad[3];
    law_real rate_radps[3];
#if LAW_DRIFT == 1
    law_real unlimited_rad[3];
#endif
    int32_t axis;
    for (axis = 0; axis < 3; ++axis) {
        law_real increment_rad = in->delta_angle_rad[axis];
        law_real whole_rad = in->attitude_error_rad[axis];
        if (REAL(LAW_COUNT_RAD) > REAL(0.0)) { /* the sum of the pulses is exact */
            increment_rad = (law_real)in->counts[axis] * REAL(LAW_COUNT_RAD);
            state->total_counts[axis] += in->counts[axis];
            state->angle_rad[axis] = (law_real)state->total_counts[axis] * REAL(LAW_COUNT_RAD);
        } else {
            state->angle_rad[axis] += increment_rad;
        }
        rate_radps[axis] = increment_rad / of->sample_s;
        if (LAW_RATE_INTEGRAL != 0) {
            whole_rad = state->angle_rad[axis] - in->commanded_angle_rad[axis];
        }
        error_rad[axis] = limited(whole_rad, of->angle_error_limit_rad);
#if LAW_DRIFT == 1
        unlimited_rad[axis] = whole_rad;
#endif
    }
#if LAW_FURTHER_GYROS > 0
    for (axis = 0; axis < 2; ++axis) {
        int32_t gyro;
        rate_radps[axis + 1] = of->blend[axis][0] * rate_radps[axis + 1];
        for (gyro = 0; gyro < LAW_FURTHER_GYROS; ++gyro) {
            rate_radps[axis + 1] += of->blend[axis][gyro + 1] * in->further_rate_radps[gyro][axis + 1];
        }
    }
#endif
    look_up(of, scheduled(of, in), gains);
#if LAW_MOVING_FILTER == 1
    if (of->filter_breaks != 0) {
        move_filter(of, state, scheduled(of, in));
    }
#endif
    for (axis = 0; axis < 2; ++axis) {
        const law_real k_p = gains[LAW_GAINS * axis];
        const law_real k_d_s = gains[LAW_GAINS * axis + 1];
#if LAW_LOOP_FILTERS == 1
        const law_real angle_in_rad = loop_filtered(of, state, 0, axis, error_rad[axis + 1]);
        const law_real rate_in_radps = loop_filtered(of, state, 1, axis, rate_radps[axis + 1]);
#else
        const law_real angle_in_rad = error_rad[axis + 1];
        const law_real rate_in_radps = rate_radps[axis + 1];
#endif
        law_real wanted_rad = -k_p * angle_in_rad - k_d_s * rate_in_radps;
#if LAW_LOAD_RELIEF > 0
        law_real side_mps2 = in->delta_velocity_mps[2 - axis] / of->sample_s;
#if LAW_LOOP_FILTERS == 1
        side_mps2 = loop_filtered(of, state, 2, axis, side_mps2);
#endif
#endif
#if LAW_LOAD_RELIEF == 1
        const law_real k_a_s2pm = (axis == 0) ? gains[2] : -gains[5];
        state->accel_mps2[axis] += of->accel_share * (side_mps2 - state->accel_mps2[axis]);
        wanted_rad += k_a_s2pm * state->accel_mps2[axis];
#elif LAW_LOAD_RELIEF == 2
        const law_real *const own = &gains[LAW_GAINS * axis]; /* k_alpha, percussion_m, accel_per_incidence_mps2 from 2 on */
        const law_real turn_radps2 = (rate_in_radps - state->rate_radps[axis]) / of->sample_s;
        const law_real there_mps2 = ((axis == 0) ? side_mps2 : -side_mps2) - own[3] * turn_radps2;
        state->accel_mps2[axis] += of->accel_share * (there_mps2 - state->accel_mps2[axis]);
        wanted_rad += -own[2] * (state->accel_mps2[axis] / own[4]);
        state->rate_radps[axis] = rate_in_radps;
#elif LAW_INTEGRAL == 1
        const law_real more_rad = of->sample_s * gains[LAW_GAINS * axis + 2] * angle_in_rad;
        law_real cut_rad = state->requested_rad[axis];
        if (limited(cut_rad, of->command_limit_rad) == cut_rad) {
            cut_rad = REAL(0.0);
        }
        if (more_rad * cut_rad >= REAL(0.0)) { /* not farther beyond the limit */
            state->integral_rad[axis] = limited(state->integral_rad[axis] + more_rad, of->integral_limit_rad);
        }
        wanted_rad -= state->integral_rad[axis];
#endif
#if LAW_DRIFT == 1
        {
            const law_real side_mps2 = in->delta_velocity_mps[2 - axis] / of->sample_s;
            const law_real forward_mps2 = in->delta_velocity_mps[0] / of->sample_s;
            const law_real *const own = &gains[LAW_GAINS * axis + 2 + LAW_INTEGRAL]; /* k_zd_radspm, k_z_radpm */
            state->drift_mps[axis] += of->sample_s
                * (((axis == 0) ? side_mps2 : -side_mps2) - forward_mps2 * unlimited_rad[axis + 1]);
            state->drift_m[axis] += of->sample_s * state->drift_mps[axis];
            wanted_rad += own[0] * state->drift_mps[axis] + own[1] * state->drift_m[axis];
        }
#endif
        state->law_rad[axis] = wanted_rad;
        state->requested_rad[axis] =
            filtered(of->sections[axis], of->section[axis], state->filter[axis], wanted_rad);
#if LAW_MOVING_FILTER == 1
        if (of->filter_breaks != 0) {
            state->requested_rad[axis] = moved(of, state, axis, wanted_rad);
        }
#endif
#if LAW_LOOP_FILTERS == 1
        state->requested_rad[axis] = faded(of, state, 3, axis, wanted_rad, state->requested_rad[axis]);
#endif
#if LAW_ADAPTIVE == 1
        if (of->adaptive != 0) {
            state->requested_rad[axis] = augmented(
                of, state, axis, error_rad[axis + 1], rate_radps[axis + 1], in->commanded_rate_radps[axis + 1],
                state->requested_rad[axis]);
        }
#endif
        out->requested_rad[axis] = state->requested_rad[axis];
        out->command_rad[axis] = converted(of, out->requested_rad[axis], &out->converter[axis]);
    }
#if LAW_LOOP_FILTERS == 1
    if (state->fading > 0) {
        state->fading -= 1;
    }
#endif
    out->roll_gimbal_rad = limited(
        -of->roll_gimbal_k_p * error_rad[0] - of->roll_gimbal_k_d_s * rate_radps[0], of->roll_gimbal_limit_rad);
    out->roll_thruster = 0;
    if (of->roll_thrusters != 0) {
        out->roll_thruster = fire(of, state, 0, error_rad[0], rate_radps[0]);
    }
    out->turn_thruster[0] = 0;
    out->turn_thruster[1] = 0;
#if LAW_TURN_THRUSTERS == 1
    for (axis = 0; axis < 2; ++axis) {
        if ((of->turn_thrusters != 0) && (in->coasting != 0)) {
            const law_real slip_radps = rate_radps[axis + 1] - in->commanded_rate_radps[axis + 1];
            out->turn_thruster[axis] = fire(of, state, axis + 1, error_rad[axis + 1], slip_radps);
        } else {
            silence(state, axis + 1);
        }
    }
#endif
}
