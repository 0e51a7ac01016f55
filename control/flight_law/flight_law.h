/* Attitude control law of a flight computer: gyro pulses and commanded angles to gimbal and thruster commands.
 *
 * C99 without library, allocation, recursion or global variables. Every loop ends at a constant of the tables, or halves
 * the breakpoints of a table, so that the time of a step is bounded; the first sample of a stage takes longer. Triples are
 * per body axis (roll, pitch, yaw), pairs per gimbal axis (pitch, yaw). The numbers of the design are in
 * flight_law_tables.h, stage by stage. With LAW_FLOAT all arithmetic but the sum of the pulses is in single precision.
 */
#ifndef FLIGHT_LAW_H
#define FLIGHT_LAW_H

#include <stdint.h>

#ifdef LAW_FLOAT
typedef float law_real;
#else
typedef double law_real;
#endif

#define LAW_MOST_SECTIONS 8

typedef struct {
    law_real time_s;                 /* vehicle clock at the end of the sample */
    law_real speed_mps;              /* navigation: relative to the rotating Earth; where gains are scheduled over it */
    law_real mass_kg;
    law_real dynamic_pressure_Pa;    /* of speed_mps in the air of this altitude */
    int32_t stage;                   /* that flies, from 0 */
    int32_t coasting;                /* 1: no engine burns; where LAW_TURN_THRUSTERS is 1 */
    int64_t counts[3];               /* gyro pulses of the sample */
    law_real delta_angle_rad[3];     /* of the sample; used instead of pulses where LAW_COUNT_RAD is 0 */
    law_real commanded_angle_rad[3]; /* sum of the commanded rates since the start; where LAW_RATE_INTEGRAL is 1 */
    law_real commanded_rate_radps[3];/* over the sample; where LAW_ADAPTIVE or LAW_TURN_THRUSTERS is 1 */
    law_real attitude_error_rad[3];  /* from the navigation, commanded to measured; where LAW_RATE_INTEGRAL is 0 */
    law_real further_rate_radps[4][3];/* rate gyros beyond the first, mean over the sample; LAW_FURTHER_GYROS of them */
    law_real delta_velocity_mps[3];  /* accelerometer, of the sample; where LAW_LOAD_RELIEF or LAW_DRIFT is not 0 */
} law_inputs;

typedef struct {
    law_real requested_rad[2]; /* before limit and converter */
    law_real command_rad[2];   /* what the output converter gives */
    int64_t converter[2];      /* its steps; 0 where LAW_DAC_STEP_RAD is 0 */
    law_real roll_gimbal_rad;  /* command in roll to several groups of engines */
    int32_t roll_thruster;     /* -1, 0, 1: torque about x */
    int32_t turn_thruster[2];  /* and in pitch and yaw, in a coast */
} law_outputs;

typedef struct {
    int64_t total_counts[3];
    law_real angle_rad[3];
    law_real integral_rad[2];
    law_real law_rad[2];       /* last command before the filter */
    law_real requested_rad[2]; /* and behind it */
    law_real accel_mps2[2];    /* behind its lag */
    law_real rate_radps[2];    /* of the sample before; where LAW_LOAD_RELIEF is 2 */
    law_real drift_mps[2];     /* velocity across the reference trajectory, along +z and -y; where LAW_DRIFT is 1 */
    law_real drift_m[2];       /* and displacement */
    int32_t adapts[2];         /* 1: the reference model runs */
    law_real added_gain[2];
    law_real total_gain[2];
    law_real reference[2][2];  /* error and rate of the reference model */
    law_real damper_rad2[2];   /* spectral damper */
    law_real high_pass[2][2];
    law_real filter[2][LAW_MOST_SECTIONS][2];
    law_real filter_parameter[4 * LAW_MOST_SECTIONS]; /* of a bending filter that changes: at the last sample */
    law_real moving[2][LAW_MOST_SECTIONS][2];         /* its integrators */
    law_real frozen[2][LAW_MOST_SECTIONS][5];         /* its sections at a separation, where it fades out */
    law_real loop_filter[3][2][LAW_MOST_SECTIONS][2]; /* of attitude error, rate, acceleration */
    law_real loop_input[3][2];                        /* last one of each */
    int32_t fading;            /* samples over which the filters of the stage before still fade out */
    int32_t old_stage;         /* whose these are */
    law_real old_filter[4][2][LAW_MOST_SECTIONS][2];  /* of the loops, and the bending filter */
    int32_t stage;
    int32_t thruster[3]; /* demand in roll, pitch and yaw */
    int32_t ticks_on[3]; /* samples of the present firing */
} law_state;

/* Everything at rest. */
void law_start(law_state *state);

/* One sample. */
void law_step(law_state *state, const law_inputs *in, law_outputs *out);

#endif
