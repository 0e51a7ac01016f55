/* Entry point and settings of maxq_app.c. */
#ifndef MAXQ_APP_H
#define MAXQ_APP_H

#include <stdint.h>

#ifndef MAXQ_APP_INSTANCE_DOUBLES
#define MAXQ_APP_INSTANCE_DOUBLES 8192 /* memory of the flight code, in units of eight bytes */
#endif

typedef struct {
    uint16_t port;
    int stream; /* 1: TCP; 0: UDP */
} MAXQ_APP_Config_t;

extern MAXQ_APP_Config_t MAXQ_APP_Config; /* a mission can load it from a table before the application starts */

void MAXQ_APP_Main(void);

#endif
