/* The law of pd.h as a library that flies in maxq.
 *
 *   simrun schema flight-software > maxq_fsw.h
 *   cc -std=c99 -O2 -shared -fPIC -o libpd_law.so pd_law.c -lm
 *   simrun nominal --set vehicle.computer.law=external --set vehicle.computer.library=./libpd_law.so
 */
#include "pd.h"

int32_t maxq_fsw_abi(void)
{
    return MAXQ_FSW_ABI;
}

int64_t maxq_fsw_bytes(void)
{
    return (int64_t)sizeof(autopilot);
}

int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    return pd_init(self, setup);
}

int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    pd_step(self, in, out);
    return 0;
}

void maxq_fsw_close(void *self)
{
    (void)self;
}
