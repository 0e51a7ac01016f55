/* The law as flight code for the simulator (maxq_fsw.h). monitor[0] and monitor[1]: what its output converter gives. */
#include "flight_law.h"
#include "flight_law_tables.h"
#include "maxq_fsw.h"

int32_t maxq_fsw_abi(void)
{
    return MAXQ_FSW_ABI;
}

int64_t maxq_fsw_bytes(void)
{
    return (int64_t)sizeof(law_state);
}

int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    int32_t known = 0;
    int32_t stage;
    law_start((law_state *)self);
    for (stage = 0; stage < LAW_STAGES; ++stage) {
        known |= (setup->sample_ns == law_stages[stage].sample_ns) ? 1 : 0;
    }
    return (known != 0) ? 0 : 1;
}

int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    law_inputs given;
    law_outputs wanted;
    int32_t i;
    int32_t gyro;
    given.time_s = (law_real)in->time_s;
    given.speed_mps = (law_real)in->speed_mps;
    given.mass_kg = (law_real)in->mass_kg;
    given.dynamic_pressure_Pa = (law_real)in->dynamic_pressure_Pa;
    given.stage = (int32_t)in->stage;
    given.coasting = 0; /* the simulator fires the thrusters in pitch and yaw, with the burns of its guidance */
    for (i = 0; i < 3; ++i) {
        given.counts[i] = in->counts[i];
        given.delta_angle_rad[i] = (law_real)in->delta_angle_rad[i];
        given.commanded_angle_rad[i] = (law_real)in->commanded_angle_rad[i];
        given.commanded_rate_radps[i] = (law_real)in->commanded_rate_radps[i];
        given.attitude_error_rad[i] = (law_real)in->attitude_error_rad[i];
        given.delta_velocity_mps[i] = (law_real)in->delta_velocity_mps[i];
        for (gyro = 0; gyro < 4; ++gyro) {
            given.further_rate_radps[gyro][i] = (law_real)in->further_rate_radps[gyro][i];
        }
    }
    law_step((law_state *)self, &given, &wanted);
    for (i = 0; i < 2; ++i) {
        out->gimbal_rad[i] = (double)wanted.requested_rad[i];
        out->monitor[i] = (double)wanted.command_rad[i];
    }
    out->roll_gimbal_rad = (double)wanted.roll_gimbal_rad;
    out->roll_thruster = wanted.roll_thruster;
    return 0;
}

void maxq_fsw_close(void *self)
{
    (void)self;
}
