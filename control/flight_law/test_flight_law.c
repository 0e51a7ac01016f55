/* The law on samples of a simulated flight: with doubles the outputs are equal to the last bit. */
#include <stdio.h>

#include "flight_law.h"
#include "flight_law_tables.h"
#include "test_vectors.h"

#ifdef LAW_FLOAT
#define TOLERANCE_RAD 2.0e-6
#else
#define TOLERANCE_RAD 0.0
#endif

static int differs(double value, double expected, double tolerance)
{
    const double difference = value - expected;
    return !((difference <= tolerance) && (difference >= -tolerance));
}

int main(void)
{
    law_state state;
    law_outputs out;
    int wrong = 0;
    int n;
    law_start(&state);
    for (n = 0; n < TEST_SAMPLES; ++n) {
        law_inputs in;
        int i;
        int gyro;
        in.time_s = (law_real)test_time_s[n];
        in.speed_mps = (law_real)test_navigation[n][0];
        in.mass_kg = (law_real)test_navigation[n][1];
        in.dynamic_pressure_Pa = (law_real)test_navigation[n][2];
        in.stage = 0;
        in.coasting = 0;
        for (i = 0; i < 3; ++i) {
            in.counts[i] = (int64_t)test_counts[n][i];
            in.delta_angle_rad[i] = (law_real)test_delta_angle_rad[n][i];
            in.commanded_angle_rad[i] = (law_real)test_commanded_angle_rad[n][i];
            in.commanded_rate_radps[i] = (law_real)test_commanded_rate_radps[n][i];
            in.attitude_error_rad[i] = (law_real)test_attitude_error_rad[n][i];
            in.delta_velocity_mps[i] = (law_real)test_delta_velocity_mps[n][i];
            for (gyro = 0; gyro < 4; ++gyro) {
                in.further_rate_radps[gyro][i] = (law_real)test_further_rate_radps[n][3 * gyro + i];
            }
        }
        law_step(&state, &in, &out);
        for (i = 0; i < 2; ++i) {
            const double step_rad = (TOLERANCE_RAD > 0.0) ? TOLERANCE_RAD + 1.001 * (double)law_stages[0].dac_step_rad : 0.0;
            wrong += differs((double)out.requested_rad[i], test_requested_rad[n][i], TOLERANCE_RAD);
            wrong += differs((double)out.command_rad[i], test_command_rad[n][i], step_rad);
        }
        wrong += (TOLERANCE_RAD > 0.0) ? 0 : (out.roll_thruster != test_roll_thruster[n]);
    }
    printf("%d samples, %d differences\n", TEST_SAMPLES, wrong);
    return (wrong == 0) ? 0 : 1;
}
