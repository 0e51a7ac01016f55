/* Guidance of the second stage: the linear tangent law to the target orbit.
 *
 * The direction of thrust is u(t) = unit(x + (a + b s) z + (c + d s) n) (Bryson & Ho, Applied Optimal Control, 2.7). Once
 * per second, Newton's method on a numerical prediction of the burn solves for a, b, c, d and the time to go, so that the
 * burn ends at the perigee of the target orbit. The cutoff is at the energy of the orbit.
 */
#ifndef GUIDANCE_H
#define GUIDANCE_H

#include "navigation.h"

#define UNKNOWNS 5
#define STEPS 24
#define SLOPE_s 100.0
#define ENDING_s 8.0

enum { WAITING, STEERING, ENDING, ENDED };

typedef struct {
    double exhaust_mps, radius_m, speed_mps, semimajor_m;
    double axes[3][3]; /* x, n, z */
    double unknown[UNKNOWNS], missed[UNKNOWNS], end[6];
    double begun_s, solved_s, next_s, last_s, last_r[3], last_v[3], accel_mps2;
    double cutoff_s; /* from now; below 0: not yet */
    int phase, known;
} guidance;

static void guide_start(guidance *g, const maxq_fsw_setup *s, const maxq_fsw_inputs *in, double exhaust_mps)
{
    memset(g, 0, sizeof *g);
    g->exhaust_mps = exhaust_mps;
    g->radius_m = s->equator_m + in->target_perigee_m;
    g->semimajor_m = s->equator_m + 0.5 * (in->target_perigee_m + in->target_apogee_m);
    g->speed_mps = sqrt(s->mu_m3ps2 * (2.0 / g->radius_m - 1.0 / g->semimajor_m));
    g->cutoff_s = -1.0;
}

static void direction(const guidance *g, const double x[UNKNOWNS], double time_s, double u[3])
{
    const double t = (time_s - g->begun_s) / SLOPE_s;
    add_scaled(g->axes[0], x[0] + x[1] * t, g->axes[2], u);
    add_scaled(u, x[2] + x[3] * t, g->axes[1], u);
    unit(u);
}

static double thrust_acceleration(const guidance *g, double time_s)
{
    const double left = 1.0 - g->accel_mps2 * (time_s - g->last_s) / g->exhaust_mps;
    return g->accel_mps2 / fmax(left, 0.01);
}

static void acceleration(
    const guidance *g, const maxq_fsw_setup *s, const double x[UNKNOWNS], double time_s, const double r[3], double a[3])
{
    double u[3];
    direction(g, x, time_s, u);
    gravitation(s, r, a);
    add_scaled(a, thrust_acceleration(g, time_s), u, a);
}

/* Predict the end of the burn from r, v by the classical Runge-Kutta method, and its residuals in km and m/s. */
static void predict(guidance *g, const maxq_fsw_setup *s, const navigation *n, const double x[UNKNOWNS], double time_s)
{
    const double h = SLOPE_s * x[4] / STEPS;
    double r[3], v[3], a[4][3], w[4][3], at[3], radius;
    int step, i;
    memcpy(r, n->r, sizeof r);
    memcpy(v, n->v, sizeof v);
    for (step = 0; step < STEPS; ++step) {
        const double t = time_s + step * h;
        memcpy(w[0], v, sizeof v);
        acceleration(g, s, x, t, r, a[0]);
        add_scaled(v, 0.5 * h, a[0], w[1]);
        add_scaled(r, 0.5 * h, w[0], at);
        acceleration(g, s, x, t + 0.5 * h, at, a[1]);
        add_scaled(v, 0.5 * h, a[1], w[2]);
        add_scaled(r, 0.5 * h, w[1], at);
        acceleration(g, s, x, t + 0.5 * h, at, a[2]);
        add_scaled(v, h, a[2], w[3]);
        add_scaled(r, h, w[2], at);
        acceleration(g, s, x, t + h, at, a[3]);
        for (i = 0; i < 3; ++i) {
            r[i] += h / 6.0 * (w[0][i] + w[3][i] + 2.0 * (w[1][i] + w[2][i]));
            v[i] += h / 6.0 * (a[0][i] + a[3][i] + 2.0 * (a[1][i] + a[2][i]));
        }
    }
    radius = norm(r);
    g->missed[0] = (radius - g->radius_m) / 1e3;
    g->missed[1] = dot(v, r) / radius;
    g->missed[2] = norm(v) - g->speed_mps;
    g->missed[3] = dot(r, g->axes[1]) / 1e3;
    g->missed[4] = dot(v, g->axes[1]);
}

static double largest(const double a[UNKNOWNS])
{
    double out = 0.0;
    int i;
    for (i = 0; i < UNKNOWNS; ++i) {
        out = fmax(out, fabs(a[i]));
    }
    return out;
}

/* Solve rows of UNKNOWNS equations, whose last column is the right-hand side; 0 if they are singular. */
static int solve_rows(double m[UNKNOWNS][UNKNOWNS + 1])
{
    int i, j, k;
    for (k = 0; k < UNKNOWNS; ++k) {
        int best = k;
        for (i = k + 1; i < UNKNOWNS; ++i) {
            best = fabs(m[i][k]) > fabs(m[best][k]) ? i : best;
        }
        if (!(fabs(m[best][k]) > 1e-12)) {
            return 0;
        }
        for (j = 0; j <= UNKNOWNS; ++j) {
            const double kept = m[k][j];
            m[k][j] = m[best][j];
            m[best][j] = kept;
        }
        for (j = UNKNOWNS; j >= k; --j) {
            m[k][j] /= m[k][k];
        }
        for (i = 0; i < UNKNOWNS; ++i) {
            const double factor = m[i][k];
            for (j = k; i != k && j <= UNKNOWNS; ++j) {
                m[i][j] -= factor * m[k][j];
            }
        }
    }
    return 1;
}

/* Newton's method with bounded steps; returns the largest residual. */
static double solve(guidance *g, const maxq_fsw_setup *s, const navigation *n, double time_s, int trials)
{
    double m[UNKNOWNS][UNKNOWNS + 1], base[UNKNOWNS], x[UNKNOWNS], step[UNKNOWNS], share;
    int i, k;
    while (trials-- > 0) {
        predict(g, s, n, g->unknown, time_s);
        if (largest(g->missed) < 1e-3) {
            break;
        }
        memcpy(base, g->missed, sizeof base);
        for (k = 0; k < UNKNOWNS; ++k) {
            const double by = k < UNKNOWNS - 1 ? 1e-5 : 1e-4;
            memcpy(x, g->unknown, sizeof x);
            x[k] += by;
            predict(g, s, n, x, time_s);
            for (i = 0; i < UNKNOWNS; ++i) {
                m[i][k] = (g->missed[i] - base[i]) / by;
                m[i][UNKNOWNS] = -base[i];
            }
        }
        if (!solve_rows(m)) {
            break;
        }
        for (k = 0; k < UNKNOWNS; ++k) {
            step[k] = m[k][UNKNOWNS];
        }
        share = fmin(1.0, 0.3 / fmax(largest(step), 1e-300));
        for (k = 0; k < UNKNOWNS; ++k) {
            g->unknown[k] += share * step[k];
        }
        g->unknown[4] = fmin(fmax(g->unknown[4], 1e-3),
                             0.95 * g->exhaust_mps / thrust_acceleration(g, time_s) / SLOPE_s);
    }
    predict(g, s, n, g->unknown, time_s);
    return largest(g->missed);
}

/* The plane, the frame and a first guess: a horizontal burn over the missing speed. */
static void choose_axes(guidance *g, const navigation *n, double inclination_rad, double time_s)
{
    const double radius = norm(n->r), speed = norm(n->v), flat = sqrt(n->r[0] * n->r[0] + n->r[1] * n->r[1]);
    double *x = g->axes[0], *normal = g->axes[1], *z = g->axes[2], ahead[3], missing, burn_s, turned;
    cross(n->r, n->v, normal);
    unit(normal);
    if (inclination_rad >= 0.0) {
        double east[3] = {-n->r[1] / flat, n->r[0] / flat, 0.0}, north[3];
        const double cosine = fmin(fmax(cos(inclination_rad) * radius / flat, -1.0), 1.0);
        const double sine = sqrt(1.0 - cosine * cosine) * (dot(normal, east) < 0.0 ? -1.0 : 1.0);
        int i;
        cross(n->r, east, north);
        unit(north);
        for (i = 0; i < 3; ++i) {
            normal[i] = cosine * north[i] + sine * east[i];
        }
    }
    missing = fabs(g->speed_mps - speed) + 9.8 * fabs(dot(n->r, n->v)) / radius / fmax(g->accel_mps2, 1.0);
    burn_s = g->exhaust_mps / g->accel_mps2 * (1.0 - exp(-missing / g->exhaust_mps));
    turned = 0.5 * (speed + g->speed_mps) * burn_s / radius;
    cross(normal, n->r, ahead);
    z[0] = z[1] = z[2] = 0.0;
    add_scaled(z, cos(turned), n->r, z);
    add_scaled(z, sin(turned), ahead, z);
    add_scaled(z, -dot(z, normal), normal, z);
    unit(z);
    cross(normal, z, x);
    g->begun_s = time_s;
    g->unknown[0] = 0.4;
    g->unknown[1] = -0.2;
    g->unknown[2] = g->unknown[3] = 0.0;
    g->unknown[4] = burn_s / SLOPE_s;
}

/* Measure the thrust acceleration over the last cycle; returns 1 if it is steady. */
static int measure_acceleration(guidance *g, const maxq_fsw_setup *s, const navigation *n, double time_s)
{
    const double since_s = time_s - g->last_s;
    double middle[3], pull[3], gained[3], mean, now;
    int steady = 0, i;
    if (g->known && since_s < 2.5) {
        for (i = 0; i < 3; ++i) {
            middle[i] = 0.5 * (n->r[i] + g->last_r[i]);
            gained[i] = (n->v[i] - g->last_v[i]) / since_s;
        }
        gravitation(s, middle, pull);
        add_scaled(gained, -1.0, pull, gained);
        mean = norm(gained);
        now = mean * (1.0 + 0.5 * since_s * mean / g->exhaust_mps);
        steady = fabs(now - g->accel_mps2) < 0.1 * now;
        g->accel_mps2 = now;
    }
    g->known = 1;
    g->last_s = time_s;
    memcpy(g->last_r, n->r, sizeof g->last_r);
    memcpy(g->last_v, n->v, sizeof g->last_v);
    return steady && g->accel_mps2 > 1.0;
}

/* One sample of the closed loop; returns 1 while u is the direction of thrust. */
static int guide(
    guidance *g, const maxq_fsw_setup *s, const navigation *n, const maxq_fsw_inputs *in, double u[3])
{
    const double t = in->time_s, sample_s = 1e-9 * (double)s->sample_ns;
    if (g->phase < ENDING && t >= g->next_s) {
        g->next_s = t + 1.0;
        if (measure_acceleration(g, s, n, t)) {
            if (g->phase != STEERING) {
                choose_axes(g, n, in->target_inclination_rad, t);
            }
            if (solve(g, s, n, t, g->phase == STEERING ? 3 : 40) < 1.0) {
                g->phase = STEERING;
                g->solved_s = t;
            } else if (g->phase == STEERING && t - g->solved_s > 10.0) {
                g->phase = WAITING;
            }
        }
    }
    if (g->phase == STEERING && g->solved_s + SLOPE_s * g->unknown[4] - t < ENDING_s) {
        g->phase = ENDING;
    }
    if (g->phase == WAITING) {
        return 0;
    }
    direction(g, g->unknown, t, u);
    if (g->phase == ENDING) { /* the energy that is missing, over the power of the thrust and its growth */
        const double wanted =
            0.5 * s->mu_m3ps2 * (2.0 / norm(n->r) - 1.0 / g->semimajor_m) - 0.5 * dot(n->v, n->v);
        const double a = thrust_acceleration(g, t), power = a * dot(u, n->v);
        const double growth = a * a + power * a / g->exhaust_mps;
        double left_s = wanted / power;
        left_s = wanted / (power + 0.5 * growth * left_s);
        if (left_s < 1.5 * sample_s) {
            g->cutoff_s = fmax(left_s, 0.0);
            g->phase = ENDED;
        }
    }
    return 1;
}

#endif
