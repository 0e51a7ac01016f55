/* Navigation: strapdown integration of gyro and accelerometer increments, corrected by GNSS.
 *
 * Of three inertial units, the middle increment counts. A unit whose increments remain apart from it has failed and is
 * not used again; of two units, the mean counts, because the greater of two rounded increments would drift. Position and
 * velocity are those of the accelerometer, in I. A Kalman filter with a position and a velocity error per axis (the same
 * covariance for all axes) weighs each GNSS solution. The solution is compared with the state at the time at which it was
 * valid. Solutions farther off than GATE standard deviations are rejected. A velocity error that returns is that of a
 * tilted platform: the tilt, as the error of the direction of the specific force, is estimated with a twentieth of the
 * bandwidth of the velocity. With a quarter, its noise could lose GNSS after an outage of a minute.
 */
#ifndef NAVIGATION_H
#define NAVIGATION_H

#include "maxq_fsw.h"
#include "vectors.h"

#include <string.h>

#define HISTORY 64          /* samples; more than the latency of the receiver */
#define GNSS_POSITION_m 5.0 /* standard deviations assumed, per axis */
#define GNSS_VELOCITY_mps 0.1
#define DRIFT_m2ps3 1e-4    /* density of the acceleration error */
#define GATE 6.0
#define APART_SAMPLES 50.0   /* over which increments are compared */
#define APART_radps 3.5e-4   /* 0.02 deg/s */
#define APART_mps2 0.1

typedef struct {
    double time_s, r[3], v[3];
} moment;

typedef struct {
    double angle_rad[3], velocity_mps[3]; /* increments of the sample */
    double apart_rad[3][3], apart_mps[3][3]; /* of each unit from the middle, mean */
    int failed[3];
    double q_BI[4], last_rad[3], r[3], v[3];
    double p_rr, p_rv, p_vv; /* covariance of an axis */
    double tilt[3], force_mps2, corrected_s; /* in I; time of the last solution */
    moment past[HISTORY];
    int64_t samples, number, used, rejected;
    int started;
} navigation;

static void nav_start(navigation *n, const maxq_fsw_setup *s)
{
    memcpy(n->q_BI, s->start_q_RI, sizeof n->q_BI);
    memcpy(n->r, s->start_r_I_m, sizeof n->r);
    memcpy(n->v, s->start_v_I_mps, sizeof n->v);
    n->p_rr = 100.0;
    n->p_rv = 0.0;
    n->p_vv = 0.01;
}

/* Gravitation of the flattened Earth at r (Vallado, eq. 8-30). */
static void gravitation(const maxq_fsw_setup *s, const double r[3], double g[3])
{
    const double radius = norm(r), k = -s->mu_m3ps2 / (radius * radius * radius), ratio = s->equator_m / radius;
    const double bulge = 1.5 * s->j2 * ratio * ratio, lift = 5.0 * (r[2] / radius) * (r[2] / radius);
    g[0] = k * (1.0 + bulge * (1.0 - lift)) * r[0];
    g[1] = k * (1.0 + bulge * (1.0 - lift)) * r[1];
    g[2] = k * (1.0 + bulge * (3.0 - lift)) * r[2];
}

/* Velocity of the Earth at r, in I. */
static void ground(const maxq_fsw_setup *s, const double r[3], double v[3])
{
    v[0] = -s->earth_rate_radps * r[1];
    v[1] = s->earth_rate_radps * r[0];
    v[2] = 0.0;
}

/* The middle of up to three numbers. */
static double middle_of(double x[3], int count)
{
    int i, j;
    for (i = 1; i < count; ++i) {
        for (j = i; j > 0 && x[j] < x[j - 1]; --j) {
            const double kept = x[j];
            x[j] = x[j - 1];
            x[j - 1] = kept;
        }
    }
    return count == 2 ? 0.5 * (x[0] + x[1]) : x[count / 2];
}

/* Compare a unit with the middle of all three; returns 1 if it has failed. */
static int apart(navigation *n, const maxq_fsw_inputs *in, int k, double sample_s)
{
    int failed = 0, axis;
    for (axis = 0; axis < 3; ++axis) {
        double *a = &n->apart_rad[k][axis], *v = &n->apart_mps[k][axis];
        *a += (in->imu_delta_angle_rad[k][axis] - n->angle_rad[axis] - *a) / APART_SAMPLES;
        *v += (in->imu_delta_velocity_mps[k][axis] - n->velocity_mps[axis] - *v) / APART_SAMPLES;
        failed |= fabs(*a) > APART_radps * sample_s || fabs(*v) > APART_mps2 * sample_s;
    }
    return failed;
}

/* Select the increments of each axis: the middle one of the units whose samples have arrived, else of the first unit. */
static void nav_select(navigation *n, const maxq_fsw_inputs *in, double sample_s)
{
    int unit[3], count = 0, axis, k;
    for (k = 0; k < 3; ++k) {
        if (k < in->imu_count && (in->imu_health >> k & 1) && !n->failed[k]) {
            unit[count++] = k;
        }
    }
    unit[0] = count > 0 ? unit[0] : 0;
    count = count > 0 ? count : 1;
    for (axis = 0; axis < 3; ++axis) {
        double angle[3], velocity[3];
        for (k = 0; k < count; ++k) {
            angle[k] = in->imu_delta_angle_rad[unit[k]][axis];
            velocity[k] = in->imu_delta_velocity_mps[unit[k]][axis];
        }
        n->angle_rad[axis] = middle_of(angle, count);
        n->velocity_mps[axis] = middle_of(velocity, count);
    }
    for (k = 0; count == 3 && k < 3; ++k) {
        n->failed[k] = apart(n, in, k, sample_s);
        count -= n->failed[k];
    }
}

/* Correct the state by a GNSS solution. */
static void nav_correct(navigation *n, const maxq_fsw_setup *s, const maxq_fsw_inputs *in)
{
    const double angle = s->earth_rate_radps * in->gnss_time_s, sample_s = 1e-9 * (double)s->sample_ns;
    double r[3], v[3], spin[3], arm[3], swing[3], rate[3], miss_r[3], miss_v[3];
    int64_t ago = (int64_t)floor((in->time_s - in->gnss_time_s) / sample_s + 0.5);
    double s_rr, s_vv, det, share, k[2][2], p_rr = n->p_rr, p_rv = n->p_rv, p_vv = n->p_vv, largest = 0.0;
    const moment *then;
    int i;
    if (ago < 0 || ago >= HISTORY || ago >= n->samples) {
        return;
    }
    then = &n->past[(n->samples - 1 - ago) % HISTORY];
    about_z(angle, in->gnss_r_E_m, r);
    about_z(angle, in->gnss_v_E_mps, v);
    ground(s, r, spin);
    add_scaled(v, 1.0, spin, v);
    for (i = 0; i < 3; ++i) {
        rate[i] = n->angle_rad[i] / sample_s;
    }
    rotate(n->q_BI, s->gnss_lever_B_m, arm);
    cross(rate, s->gnss_lever_B_m, swing);
    rotate(n->q_BI, swing, swing);
    for (i = 0; i < 3; ++i) {
        miss_r[i] = r[i] - arm[i] - then->r[i];
        miss_v[i] = v[i] - swing[i] - then->v[i];
        largest = fmax(largest, miss_r[i] * miss_r[i] / (p_rr + GNSS_POSITION_m * GNSS_POSITION_m));
        largest = fmax(largest, miss_v[i] * miss_v[i] / (p_vv + GNSS_VELOCITY_mps * GNSS_VELOCITY_mps));
    }
    if (largest > GATE * GATE) {
        ++n->rejected;
        return;
    }
    ++n->used;
    s_rr = p_rr + GNSS_POSITION_m * GNSS_POSITION_m;
    s_vv = p_vv + GNSS_VELOCITY_mps * GNSS_VELOCITY_mps;
    det = s_rr * s_vv - p_rv * p_rv;
    k[0][0] = (p_rr * s_vv - p_rv * p_rv) / det;
    k[0][1] = (p_rv * s_rr - p_rr * p_rv) / det;
    k[1][0] = (p_rv * s_vv - p_vv * p_rv) / det;
    k[1][1] = (p_vv * s_rr - p_rv * p_rv) / det;
    share = 0.05 * k[1][1] * k[1][1] / fmax(in->gnss_time_s - n->corrected_s, sample_s) / n->force_mps2;
    for (i = 0; i < 3; ++i) {
        n->r[i] += k[0][0] * miss_r[i] + k[0][1] * miss_v[i];
        n->v[i] += k[1][0] * miss_r[i] + k[1][1] * miss_v[i];
        n->tilt[i] += n->used > 1 && n->force_mps2 > 1.0 ? share * miss_v[i] : 0.0;
    }
    n->corrected_s = in->gnss_time_s;
    n->p_rr = p_rr - k[0][0] * p_rr - k[0][1] * p_rv;
    n->p_rv = p_rv - k[0][0] * p_rv - k[0][1] * p_vv;
    n->p_vv = p_vv - k[1][0] * p_rv - k[1][1] * p_vv;
}

/* One sample. On the pad, the vehicle moves with the Earth. */
static void nav_step(navigation *n, const maxq_fsw_setup *s, const maxq_fsw_inputs *in)
{
    const double h = 1e-9 * (double)s->sample_ns;
    double by[3], half[4], dv[3], g[3], before[3], middle[3];
    int i;
    moment *now;
    nav_select(n, in, h);
    cross(n->last_rad, n->angle_rad, by); /* coning, as Savage, J. Guidance 21(1), 1998 */
    add_scaled(n->angle_rad, 1.0 / 12.0, by, by);
    memcpy(n->last_rad, n->angle_rad, sizeof n->last_rad);
    memcpy(half, n->q_BI, sizeof half);
    turn(n->q_BI, by);
    if ((in->discretes & MAXQ_FSW_LIFTOFF) == 0 && !n->started) {
        about_z(s->earth_rate_radps * (in->time_s - 1e-9 * (double)s->start_ns), s->start_r_I_m, n->r);
        ground(s, n->r, n->v);
    } else {
        n->started = 1;
        for (i = 0; i < 3; ++i) {
            by[i] *= 0.5;
        }
        turn(half, by);
        rotate(half, n->velocity_mps, dv);
        add_scaled(n->r, 0.5 * h, n->v, middle);
        gravitation(s, middle, g);
        memcpy(before, n->v, sizeof before);
        n->force_mps2 = norm(dv) / h;
        add_scaled(n->v, 1.0, dv, n->v);
        add_scaled(n->v, n->force_mps2 * h, n->tilt, n->v);
        add_scaled(n->v, h, g, n->v);
        add_scaled(n->r, 0.5 * h, before, n->r);
        add_scaled(n->r, 0.5 * h, n->v, n->r);
        n->p_rr += h * (2.0 * n->p_rv + h * n->p_vv);
        n->p_rv += h * n->p_vv;
        n->p_vv += h * DRIFT_m2ps3;
    }
    now = &n->past[n->samples % HISTORY];
    now->time_s = in->time_s;
    memcpy(now->r, n->r, sizeof now->r);
    memcpy(now->v, n->v, sizeof now->v);
    ++n->samples;
    if (in->gnss_number != n->number) {
        n->number = in->gnss_number;
        if (n->started) {
            nav_correct(n, s, in);
        }
    }
}

#endif
