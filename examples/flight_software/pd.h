/* The law of the built-in design ksr3-robust, written by hand: PD, bending filter, roll thrusters. */
#ifndef PD_H
#define PD_H

#include "maxq_fsw.h"

#include <math.h>

#define PI 3.14159265358979323846
#define SECTIONS 2
#define PITCH 1 /* of triples; pairs begin with pitch */

typedef struct {
    double b0, b1, b2, a1, a2;
} biquad;

typedef struct {
    biquad filter[SECTIONS];
    double memory[2][SECTIONS][2]; /* pitch and yaw */
    int64_t thruster, ticks_on, shortest_ticks;
} autopilot;

static const double gain_time_s[2] = {5.0, 55.0};
static const double gain_p[2] = {1.09853423, 0.724467989};
static const double gain_d_s[2] = {0.467470625, 0.369753066};

/* Linear between two points, held outside. */
static double scheduled(const double value[2], double time_s)
{
    const double share = (time_s - gain_time_s[0]) / (gain_time_s[1] - gain_time_s[0]);
    if (share <= 0.0) {
        return value[0];
    }
    return share >= 1.0 ? value[1] : value[0] + share * (value[1] - value[0]);
}

/* (s^2/wz^2 + 2 zz s/wz + 1) / (s^2/wp^2 + 2 zp s/wp + 1) with s = c (z - 1)/(z + 1). */
static biquad bilinear(double c, double zero_hz, double zero_zeta, double pole_hz, double pole_zeta)
{
    const double n1 = 2.0 * zero_zeta * c / (2.0 * PI * zero_hz), n2 = c * c / (4.0 * PI * PI * zero_hz * zero_hz);
    const double d1 = 2.0 * pole_zeta * c / (2.0 * PI * pole_hz), d2 = c * c / (4.0 * PI * PI * pole_hz * pole_hz);
    const double a0 = 1.0 + d1 + d2;
    biquad out;
    out.b0 = (1.0 + n1 + n2) / a0;
    out.b1 = 2.0 * (1.0 - n2) / a0;
    out.b2 = (1.0 - n1 + n2) / a0;
    out.a1 = 2.0 * (1.0 - d2) / a0;
    out.a2 = (1.0 - d1 + d2) / a0;
    return out;
}

/* Transposed direct form II. */
static double filtered(const biquad *filter, double memory[SECTIONS][2], double value)
{
    int i;
    for (i = 0; i < SECTIONS; ++i) {
        const biquad *f = &filter[i];
        const double out = f->b0 * value + memory[i][0];
        memory[i][0] = f->b1 * value - f->a1 * out + memory[i][1];
        memory[i][1] = f->b2 * value - f->a2 * out;
        value = out;
    }
    return value;
}

/* Switching line with dead band 1 deg, hysteresis 0.2 deg and a shortest firing of 0.02 s. */
static int64_t roll_thruster(autopilot *self, double error_rad, double rate_radps)
{
    const double on = PI / 180.0, off = 0.8 * PI / 180.0, s = error_rad + 0.5 * rate_radps;
    int64_t wanted = 0;
    if (self->thruster != 0 && self->ticks_on < self->shortest_ticks) {
        ++self->ticks_on;
        return self->thruster;
    }
    if (s > on || (self->thruster < 0 && s > off)) {
        wanted = -1;
    } else if (s < -on || (self->thruster > 0 && s < -off)) {
        wanted = 1;
    }
    self->ticks_on = wanted == 0 ? 0 : (wanted == self->thruster ? self->ticks_on + 1 : 1);
    self->thruster = wanted;
    return wanted;
}

static int32_t pd_init(autopilot *a, const maxq_fsw_setup *setup)
{
    const double sample_s = 1e-9 * (double)setup->sample_ns, w = 2.0 * PI * 9.8;
    const double c = w / tan(0.5 * w * sample_s);
    if (setup->sample_ns != 10000000) {
        return 1; /* made for 100 Hz */
    }
    a->filter[0] = bilinear(c, 28.480032, 0.315292215, 13.7014172, 1.2);
    a->filter[1] = bilinear(c, 3.76992765, 1.2, 5.73048187, 0.3);
    a->shortest_ticks = 2;
    return 0;
}

static void pd_step(autopilot *a, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    const double k_p = scheduled(gain_p, in->time_s), k_d_s = scheduled(gain_d_s, in->time_s);
    int i;
    for (i = 0; i < 2; ++i) {
        const double error_rad = in->angle_rad[PITCH + i] - in->commanded_angle_rad[PITCH + i];
        const double wanted = -k_p * error_rad - k_d_s * in->rate_radps[PITCH + i];
        out->gimbal_rad[i] = filtered(a->filter, a->memory[i], wanted);
    }
    out->roll_thruster = roll_thruster(a, in->angle_rad[0] - in->commanded_angle_rad[0], in->rate_radps[0]);
}

#endif
