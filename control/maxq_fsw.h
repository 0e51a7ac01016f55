/* maxq_fsw.h: flight code in the simulator of maxq, version 2 of the interface.
 *
 * A shared library exports the five functions at the end; `[computer] law = "external"` and `library = "libfsw.so"` in a
 * vehicle file select it. SI units; body axes x forward, y, z, as in docs/model.md; triples are roll, pitch, yaw.
 * Every field has eight bytes. Later versions only add fields at the end of a struct: `bytes` gives the size.
 * Code compiled with version 1 runs unchanged.
 *
 * The simulator calls maxq_fsw_step once each sample. It owns the memory of an instance, so that the code need not
 * allocate any: several instances can fly in parallel if no other memory is used.
 */
#ifndef MAXQ_FSW_H
#define MAXQ_FSW_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MAXQ_FSW_ABI 2
#define MAXQ_FSW_HEALTH_GYRO 1 /* bit of health: all gyro increments of the sample were valid */
#define MAXQ_FSW_HEALTH_ACCELEROMETER 2 /* its sample has arrived */
#define MAXQ_FSW_HEALTH_RATE_GYROS 4    /* the samples of all further rate gyros have arrived */
#define MAXQ_FSW_HEALTH_GNSS 8          /* the receiver has a solution, not older than its period and latency */
#define MAXQ_FSW_HEALTH_BAROMETER 16    /* there is one, and its sample has arrived */
#define MAXQ_FSW_HEALTH_MAGNETOMETER 32 /* there is one, and its sample has arrived */
#define MAXQ_FSW_LIFTOFF 1                         /* bit of discretes: the vehicle has left the pad */
#define MAXQ_FSW_SEPARATED(stage) (2LL << (stage)) /* bit of discretes: this stage, from 0, has ended */

typedef struct maxq_fsw_setup {
    int64_t bytes;               /* size of this struct */
    int64_t abi;                 /* version that the simulator uses, that of the code */
    int64_t sample_ns;           /* sample period */
    int64_t delay_ns;            /* from a sample to the effect of its command */
    int64_t start_ns;            /* vehicle clock at the start; the first sample ends sample_ns later */
    int64_t groups;              /* groups of engines that move together, of the first stage */
    double count_rad;            /* angle per gyro pulse; 0: not quantised */
    double dac_step_rad;         /* step of the output converter; 0: not quantised */
    double command_limit_rad;    /* of the gimbal command */
    double angle_error_limit_rad;/* of the built-in law's attitude error */
    char settings[256];          /* text of the key settings, ends with a zero */
    /* version 2; I: inertial, the Earth-fixed frame E at vehicle clock 0; R: the body at the start */
    int64_t sequencing;          /* 1: this code commands the sequence: ignition to abort of the outputs */
    int64_t stages;              /* stages, also those that only drop boosters or a fairing */
    double start_q_RI[4];        /* attitude at the start, R to I; scalar first */
    double start_r_I_m[3];       /* navigated position of the CG at the start */
    double start_v_I_mps[3];     /* navigated velocity of the CG at the start */
    double gnss_lever_B_m[3];    /* from the accelerometer to the antenna; 0 without either */
    double earth_rate_radps;     /* Earth: rate about z, gravitation and J2, equatorial radius */
    double mu_m3ps2;
    double j2;                   /* 0: spherical gravitation */
    double equator_m;
} maxq_fsw_setup;

typedef struct maxq_fsw_inputs {
    int64_t bytes;                  /* size of this struct */
    int64_t time_ns;                /* vehicle clock at the end of the sample */
    int64_t tick;                   /* number of earlier samples */
    int64_t stage;                  /* current stage, from 0 */
    int64_t health;                 /* bits MAXQ_FSW_HEALTH_... */
    double time_s;                  /* time_ns / 1e9 */
    int64_t counts[3];              /* gyro pulses of the sample; 0 where not quantised */
    double delta_angle_rad[3];      /* angle of these pulses */
    double angle_rad[3];            /* their sum since the start */
    double rate_radps[3];           /* in the law: delta_angle_rad / sample period, or blended with further gyros */
    double commanded_angle_rad[3];  /* guidance programme: sum of the commanded rates */
    double commanded_rate_radps[3]; /* mean over the sample */
    double attitude_error_rad[3];   /* limited, as the built-in law has it: roll and tilt, or angle less command */
    double q_BR[4];                 /* attitude by the counts, body to R: the body at the start; scalar first */
    double commanded_q_BR[4];       /* of the guidance */
    double delta_velocity_mps[3];   /* accelerometer: specific force over the sample; 0 without one */
    double further_rate_radps[4][3];/* rate gyros beyond the first, mean over the sample */
    double speed_mps;               /* navigation, without error: relative to the rotating Earth */
    double mass_kg;                 /* of the vehicle */
    double dynamic_pressure_Pa;     /* of speed_mps at the air density of this altitude, without wind */
    /* version 2 */
    int64_t discretes;              /* bits MAXQ_FSW_LIFTOFF, MAXQ_FSW_SEPARATED(stage) */
    int64_t gnss_number;            /* solutions received so far; the last one follows, all 0 before the first */
    double gnss_time_s;             /* vehicle clock at which it was valid */
    double gnss_r_E_m[3];           /* position of the antenna, Earth-fixed */
    double gnss_v_E_mps[3];         /* velocity of the antenna relative to the Earth, Earth-fixed */
    double pressure_Pa;             /* barometer; 0 without one */
    double magnetic_B_T[3];         /* magnetometer; 0 without one */
    double chamber_pressure[9];     /* of each engine, 1 at its largest thrust */
    double tank_kg[8];              /* liquid in each tank */
    double target_perigee_m;        /* altitude above equator_m; 0 without a target */
    double target_apogee_m;         /* likewise */
    double target_inclination_rad;  /* -1: the plane of flight */
    int64_t imu_count;              /* inertial units: gyro n and accelerometer n; 0 without an accelerometer */
    int64_t imu_health;             /* bit n: both samples of unit n, from 0, have arrived; if not, the last ones follow */
    double imu_delta_angle_rad[3][3];    /* gyro of each unit, of the sample */
    double imu_delta_velocity_mps[3][3]; /* accelerometer of each unit, of the sample */
} maxq_fsw_inputs;

typedef struct maxq_fsw_outputs { /* all 0 before each call, except bytes */
    int64_t bytes;           /* size of this struct */
    double gimbal_rad[2];    /* command in pitch and in yaw; limit and converter come after it */
    double roll_gimbal_rad;  /* command in roll by gimbals, for several groups of engines */
    int64_t roll_thruster;   /* -1, 0, 1: torque about x by thrusters */
    double monitor[8];       /* free; monitor_1 ... monitor_8 of the log */
    /* version 2; a command of the sequence acts when it changes from 0, and is ignored where it has no effect */
    int64_t ignition;        /* of all engines of the stage, also again after a cutoff */
    int64_t cutoff;          /* of all engines of the stage */
    double cutoff_delay_s;   /* from the time at which other commands act to the cutoff */
    double throttle;         /* of all engines, 0.1 to 1.2; 0: as before, which is 1 at an ignition */
    int64_t stage_separation;   /* end of the stage */
    int64_t booster_separation; /* end of the stage by that of its boosters */
    int64_t fairing_separation; /* end of the stage by that of the fairing */
    int64_t abort;           /* not 0: ends the flight with this number */
    int64_t turn_thruster[2];/* -1, 0, 1: torque in pitch and in yaw by thrusters */
    double commanded_q_BR[4];/* attitude commanded by this code; 0: that of the inputs */
} maxq_fsw_outputs;

#if defined(_WIN32)
#define MAXQ_FSW_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define MAXQ_FSW_EXPORT __attribute__((visibility("default")))
#else
#define MAXQ_FSW_EXPORT
#endif

MAXQ_FSW_EXPORT int32_t maxq_fsw_abi(void);   /* returns MAXQ_FSW_ABI, the version of this code */
MAXQ_FSW_EXPORT int64_t maxq_fsw_bytes(void); /* memory of one instance */
/* self: memory of one instance, zeroed, aligned to 64 bytes. These two return 0, or 1 to 99 to end the flight. */
MAXQ_FSW_EXPORT int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup);
MAXQ_FSW_EXPORT int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out);
MAXQ_FSW_EXPORT void maxq_fsw_close(void *self);

#ifdef __cplusplus
}
#endif

#endif
