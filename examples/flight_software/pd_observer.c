/* The law of pd.h with an observer beside it: angular acceleration by all that is not the gimbal (wind, slosh, thrust
 * misalignment), estimated from rate and command.
 *
 *   cc -std=c99 -O2 -shared -fPIC -o libpd_observer.so pd_observer.c -lm
 *   simrun nominal --set vehicle.computer.law=external --set vehicle.computer.library=./libpd_observer.so
 *
 * The log has the estimates: monitor_1, monitor_2 (rad/s2, pitch and yaw), monitor_3, monitor_4 (rate, rad/s). As it is
 * the observer only looks on; with --set vehicle.computer.settings="trim=0.5" half of the estimate is trimmed away.
 *
 * Model per axis: q' = m delta + d, d' = 0, with m the effect of the gimbal; both observer poles at 3 rad/s.
 */
#include "pd.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    autopilot law;
    double sample_s, trim;
    double rate_radps[2], disturbance_radps2[2], command_rad[2];
} observer;

/* Thrust times lever arm over inertia of KSR-III, rad/s2 per rad: 10.2 at lift-off, 15 at burn-out. */
static double gimbal_effect(double time_s)
{
    const double burnt = time_s < 0.0 ? 0.0 : (time_s > 58.0 ? 1.0 : time_s / 58.0);
    return 10.2 + 4.9 * burnt * burnt;
}

static void observe(observer *o, int axis, double measured_radps, double effect)
{
    const double pole = exp(-3.0 * o->sample_s);
    const double slope = effect * o->command_rad[axis] + o->disturbance_radps2[axis];
    const double predicted = o->rate_radps[axis] + o->sample_s * slope, error = measured_radps - predicted;
    o->rate_radps[axis] = predicted + (1.0 - pole * pole) * error;
    o->disturbance_radps2[axis] += (1.0 - pole) * (1.0 - pole) / o->sample_s * error;
}

int32_t maxq_fsw_abi(void)
{
    return MAXQ_FSW_ABI;
}

int64_t maxq_fsw_bytes(void)
{
    return (int64_t)sizeof(observer);
}

int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    observer *o = self;
    const char *trim = strstr(setup->settings, "trim=");
    o->trim = trim == NULL ? 0.0 : strtod(trim + 5, NULL);
    o->sample_s = 1e-9 * (double)setup->sample_ns;
    return pd_init(&o->law, setup);
}

int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    observer *o = self;
    const double effect = gimbal_effect(in->time_s);
    int i;
    pd_step(&o->law, in, out);
    for (i = 0; i < 2; ++i) {
        observe(o, i, in->rate_radps[PITCH + i], effect);
        out->gimbal_rad[i] -= o->trim * o->disturbance_radps2[i] / effect;
        o->command_rad[i] = out->gimbal_rad[i];
        out->monitor[i] = o->disturbance_radps2[i];
        out->monitor[2 + i] = o->rate_radps[i];
    }
    return 0;
}

void maxq_fsw_close(void *self)
{
    (void)self;
}
