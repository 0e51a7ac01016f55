/* The whole flight computer of the launcher petrel: navigation, guidance, sequence and control, from pad to orbit.
 *
 *   sed '/^gyro_station_m/a accelerometer_station_m = 6.8' ../../../scenarios/layouts/petrel.toml > petrel.toml
 *   simvehicle petrel.toml --out petrel
 *   simdesign export petrel/design.toml --scenario petrel/scenario.toml --c law
 *   cc -std=c99 -O2 -ffp-contract=off -shared -fPIC -DLAW_COUNT_RAD=0.0 -Ilaw -o libflight_computer.so \
 *       flight_computer.c law/flight_law.c law/flight_law_tables.c -lm
 *   simrun petrel/scenario.toml --set vehicle.computer.law=external --set vehicle.computer.sequencing=flight-code \
 *       --set vehicle.computer.library=./libflight_computer.so --set 'vehicle.gnss={station_m=3.0}' \
 *       --set 'guidance.orbit={perigee_altitude_m=250e3, apogee_altitude_m=300e3, isp_s=343.0}'
 *
 * With LAW_COUNT_RAD 0, the law takes angles: the increments that the navigation selects are not whole gyro pulses.
 *
 * If the key settings contains "programme", the attitude is that of the scenario's programme, and the engine burns until
 * its propellant is consumed.
 */
#include "flight_law.h"
#include "flight_law_tables.h"
#include "guidance.h"

#define PITCH_FIRST_s 5.0 /* of the table of the first stage */
#define PITCH_EVERY_s 5.0
#define TURN_RATE_radps 0.0524 /* limit of the commanded attitude */
#define SEPARATION_s 1.0       /* after the burnout of the first stage */
#define IGNITION_s 2.0         /* of the second stage, after the separation */
#define FAIRING_s 39.87        /* after this ignition */
#define EXHAUST_mps (343.0 * 9.80665)
#define DEG 57.29577951308232

/* Pitch from the vertical, deg: a gravity turn without wind. In wind, a turn along the velocity would not keep its path. */
static const double pitch_deg[] = {
    0.0, 1.85, 3.70, 5.97, 8.79, 11.87, 15.08, 18.35, 21.61, 24.84, 27.98, 31.00, 33.86, 36.54, 39.02, 41.30, 43.39, 45.30,
    47.04, 48.62, 50.05, 51.35, 52.53, 53.60
};

enum { PAD, FIRST_STAGE, BURNED_OUT, SEPARATED, SECOND_STAGE, CUT_OFF };

typedef struct {
    maxq_fsw_setup setup;
    law_state law;
    navigation nav;
    guidance orbit;
    double q_CR[4]; /* commanded attitude to R */
    double since_s; /* beginning of the phase */
    int phase, lit, fairing, programme;
} computer;

int32_t maxq_fsw_abi(void)
{
    return MAXQ_FSW_ABI;
}

int64_t maxq_fsw_bytes(void)
{
    return (int64_t)sizeof(computer);
}

int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    computer *c = self;
    if (setup->bytes < (int64_t)sizeof *setup || setup->sample_ns != law_stages[0].sample_ns) {
        return 1;
    }
    if (LAW_COUNT_RAD > 0.0) { /* compiled without -DLAW_COUNT_RAD=0.0 */
        return 2;
    }
    c->setup = *setup;
    c->programme = strstr(setup->settings, "programme") != NULL;
    c->q_CR[0] = 1.0;
    law_start(&c->law);
    nav_start(&c->nav, setup);
    return 0;
}

static void enter(computer *c, int phase, double time_s)
{
    c->phase = phase;
    c->since_s = time_s;
}

/* Ignitions, separations and the cutoff. */
static void sequence(computer *c, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    const double t = in->time_s, delay_s = 1e-9 * (double)c->setup.delay_ns;
    const int burns = in->chamber_pressure[0] > 0.5;
    switch (c->phase) {
    case PAD:
        out->ignition = 1;
        c->lit = 0;
        enter(c, FIRST_STAGE, t);
        break;
    case FIRST_STAGE:
        c->lit |= burns;
        if (c->lit && in->chamber_pressure[0] < 0.01) {
            enter(c, BURNED_OUT, t);
        }
        break;
    case BURNED_OUT:
        out->stage_separation = t - c->since_s > SEPARATION_s;
        if (in->discretes & MAXQ_FSW_SEPARATED(0)) {
            enter(c, SEPARATED, t);
        }
        break;
    case SEPARATED:
        if (t - c->since_s > IGNITION_s) {
            out->ignition = 1;
            c->lit = 0;
            guide_start(&c->orbit, &c->setup, in, EXHAUST_mps);
            enter(c, SECOND_STAGE, t);
        }
        break;
    case SECOND_STAGE:
        c->lit |= burns;
        out->fairing_separation = t - c->since_s > FAIRING_s && !(in->discretes & MAXQ_FSW_SEPARATED(1));
        if (c->orbit.cutoff_s >= 0.0) {
            out->cutoff = 1;
            out->cutoff_delay_s = fmax(c->orbit.cutoff_s - delay_s, 0.0);
        }
        if (c->orbit.cutoff_s >= 0.0 || (c->lit && in->chamber_pressure[0] < 0.01)) {
            enter(c, CUT_OFF, t);
        }
        break;
    default:
        break;
    }
}

/* Turn the commanded attitude towards the direction u in I, within the rate limit. */
static void turn_towards(computer *c, const double u[3], double limit_rad)
{
    double q[4], back[4], own[3], by[3], sine, angle;
    product(c->setup.start_q_RI, c->q_CR, q);
    conjugate(q, back);
    rotate(back, u, own);
    sine = sqrt(own[1] * own[1] + own[2] * own[2]);
    angle = fmin(atan2(sine, own[0]), limit_rad);
    by[0] = 0.0;
    by[1] = sine > 0.0 ? -angle * own[2] / sine : 0.0;
    by[2] = sine > 0.0 ? angle * own[1] / sine : 0.0;
    turn(c->q_CR, by);
}

/* The commanded attitude of this sample. */
static void steer(computer *c, const maxq_fsw_inputs *in)
{
    const int last = (int)(sizeof pitch_deg / sizeof *pitch_deg) - 1;
    const double h = 1e-9 * (double)c->setup.sample_ns;
    const double place = fmin(fmax((in->time_s - PITCH_FIRST_s) / PITCH_EVERY_s, 0.0), (double)last);
    const int k = place < last ? (int)place : last - 1;
    double u[3], half;
    if (c->programme) {
        memcpy(c->q_CR, in->commanded_q_BR, sizeof c->q_CR);
    } else if (c->phase == SECOND_STAGE) {
        if (c->lit && guide(&c->orbit, &c->setup, &c->nav, in, u)) {
            turn_towards(c, u, TURN_RATE_radps * h);
        }
    } else if (c->phase < SEPARATED) {
        half = -0.5 * (pitch_deg[k] + (place - k) * (pitch_deg[k + 1] - pitch_deg[k])) / DEG;
        c->q_CR[0] = cos(half);
        c->q_CR[2] = sin(half);
    }
}

static double limited(double value, double limit)
{
    return fmin(fmax(value, -limit), limit);
}

/* Roll, and tilt about y and z, from the commanded to the measured attitude, as in the built-in computer. */
static void attitude_error(const computer *c, law_real out[3])
{
    double q[4], r[4], back[4], y, z, sine, cosine, k;
    conjugate(c->setup.start_q_RI, back);
    product(back, c->nav.q_BI, r);
    conjugate(c->q_CR, back);
    product(back, r, q);
    y = 2.0 * (q[1] * q[3] + q[0] * q[2]);
    z = 2.0 * (q[0] * q[3] - q[1] * q[2]);
    sine = sqrt(y * y + z * z);
    cosine = q[0] * q[0] + q[1] * q[1] - q[2] * q[2] - q[3] * q[3];
    k = sine < 1e-4 && cosine > 0.0 ? 1.0 + sine * sine / 6.0 : atan2(sine, cosine) / fmax(sine, 1e-9);
    out[0] = limited(2.0 * atan2(q[0] < 0.0 ? -q[1] : q[1], fabs(q[0])), c->setup.angle_error_limit_rad);
    out[1] = limited(k * y, c->setup.angle_error_limit_rad);
    out[2] = limited(k * z, c->setup.angle_error_limit_rad);
}

int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    computer *c = self;
    law_inputs given;
    law_outputs wanted;
    int i;
    memset(&given, 0, sizeof given);
    nav_step(&c->nav, &c->setup, in);
    steer(c, in);
    sequence(c, in, out);
    attitude_error(c, given.attitude_error_rad);
    given.time_s = in->time_s;
    given.stage = (int32_t)in->stage;
    for (i = 0; i < 3; ++i) {
        given.delta_angle_rad[i] = c->nav.angle_rad[i];
        given.delta_velocity_mps[i] = c->nav.velocity_mps[i];
        out->monitor[i] = c->nav.r[i];
        out->monitor[3 + i] = c->nav.v[i];
    }
    law_step(&c->law, &given, &wanted);
    out->gimbal_rad[0] = wanted.requested_rad[0];
    out->gimbal_rad[1] = wanted.requested_rad[1];
    out->roll_gimbal_rad = wanted.roll_gimbal_rad;
    out->roll_thruster = wanted.roll_thruster;
    out->monitor[6] = c->phase;
    out->monitor[7] = (double)c->nav.rejected;
    memcpy(out->commanded_q_BR, c->q_CR, sizeof out->commanded_q_BR);
    return 0;
}

void maxq_fsw_close(void *self)
{
    (void)self;
}
