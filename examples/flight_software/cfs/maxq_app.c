/* A cFS application that flies in maxq: flight code (maxq_fsw.h) behind a socket of OSAL.
 *
 * The application calls cFE and OSAL by their own names. Here, posix/cfe.h and posix/cfe.c replace the functions that
 * it needs, so that it builds with a C compiler alone:
 *
 *   cc -std=c99 -O2 -I. -I.. -Iposix -o maxq_app maxq_app.c posix/cfe.c ../pd_law.c -lm
 *   ./maxq_app tcp 5005 &
 *   simrun nominal --set vehicle.computer.law=external --set vehicle.computer.address=tcp://127.0.0.1:5005
 *
 * In a cFS mission, leave posix/ out, and add this file, link.h, maxq_fsw.h and the flight code to the application's
 * CMake list; its entry point is MAXQ_APP_Main. The messages are handled by link.h alone, which an F Prime component can
 * call in the same way from the receive port of its byte stream driver.
 */
#include "maxq_app.h"

#include "cfe.h"
#include "link.h"

enum { LISTENING_EID = 1, CONNECTED_EID, FLIGHT_ENDED_EID, SOCKET_EID };
enum { WAIT_MS = 100 }; /* between two looks at the state of the application */

static struct {
    uint32 run_status;
    osal_id_t bound, connected;
    OS_SockAddr_t simulator;
    link_state link;
    double instance[MAXQ_APP_INSTANCE_DOUBLES];
} app;

MAXQ_APP_Config_t MAXQ_APP_Config = {5005, 1};

static int32 listen_to(uint16 port, int stream)
{
    OS_SockAddr_t here;
    int32 status = OS_SocketAddrInit(&here, OS_SocketDomain_INET);
    if (status == OS_SUCCESS) {
        status = OS_SocketAddrFromString(&here, "127.0.0.1");
    }
    if (status == OS_SUCCESS) {
        status = OS_SocketAddrSetPort(&here, port);
    }
    if (status == OS_SUCCESS) {
        status = OS_SocketOpen(
            &app.bound, OS_SocketDomain_INET, stream ? OS_SocketType_STREAM : OS_SocketType_DATAGRAM);
    }
    return status == OS_SUCCESS ? OS_SocketBind(app.bound, &here) : status;
}

static CFE_Status_t start(void)
{
    int32 status;
    CFE_Status_t registered = CFE_EVS_Register(NULL, 0, CFE_EVS_EventFilter_BINARY);
    if (registered != CFE_SUCCESS) {
        return registered;
    }
    app.connected = OS_OBJECT_ID_UNDEFINED;
    if (maxq_fsw_bytes() > (int64_t)sizeof app.instance) {
        CFE_EVS_SendEvent(SOCKET_EID, CFE_EVS_EventType_ERROR, "MAXQ_APP_INSTANCE_DOUBLES is too small");
        return CFE_STATUS_EXTERNAL_RESOURCE_FAIL;
    }
    link_start(&app.link, app.instance);
    status = listen_to(MAXQ_APP_Config.port, MAXQ_APP_Config.stream);
    if (status != OS_SUCCESS) {
        CFE_EVS_SendEvent(SOCKET_EID, CFE_EVS_EventType_ERROR, "no socket: OSAL status %ld", (long)status);
        return CFE_STATUS_EXTERNAL_RESOURCE_FAIL;
    }
    CFE_EVS_SendEvent(
        LISTENING_EID, CFE_EVS_EventType_INFORMATION, "listening on port %u", (unsigned)MAXQ_APP_Config.port);
    return CFE_SUCCESS;
}

static void disconnect(void)
{
    OS_close(app.connected);
    app.connected = OS_OBJECT_ID_UNDEFINED;
    link_start(&app.link, app.instance);
    CFE_EVS_SendEvent(FLIGHT_ENDED_EID, CFE_EVS_EventType_INFORMATION, "connection closed");
}

/* Send the answer to a whole message, if it has one. */
static void answer(void)
{
    const size_t size = link_answer(&app.link);
    int32 sent = (int32)size;
    if (size > 0 && MAXQ_APP_Config.stream) {
        sent = OS_TimedWrite(app.connected, &app.link.reply, size, WAIT_MS);
    } else if (size > 0) {
        sent = OS_SocketSendTo(app.bound, &app.link.reply, size, &app.simulator);
    }
    if (sent != (int32)size) {
        CFE_EVS_SendEvent(SOCKET_EID, CFE_EVS_EventType_ERROR, "answer not sent: OSAL status %ld", (long)sent);
    }
}

static void serve_datagram(void)
{
    const int32 got =
        OS_SocketRecvFrom(app.bound, &app.link.message, sizeof app.link.message, &app.simulator, WAIT_MS);
    app.link.have = got > 0 ? (size_t)got : 0;
    if (link_missing(&app.link) == 0) {
        answer();
    }
}

static void serve_stream(void)
{
    long missing = link_missing(&app.link);
    if (!OS_ObjectIdDefined(app.connected)) {
        if (OS_SocketAccept(app.bound, &app.connected, &app.simulator, WAIT_MS) != OS_SUCCESS) {
            app.connected = OS_OBJECT_ID_UNDEFINED;
            return;
        }
        CFE_EVS_SendEvent(CONNECTED_EID, CFE_EVS_EventType_INFORMATION, "connected");
    }
    if (missing > 0) {
        const int32 got =
            OS_TimedRead(app.connected, (char *)&app.link.message + app.link.have, (size_t)missing, WAIT_MS);
        if (got == OS_ERROR_TIMEOUT) {
            return;
        }
        if (got <= 0) {
            disconnect();
            return;
        }
        app.link.have += (size_t)got;
        missing = link_missing(&app.link);
    }
    if (missing == 0) {
        answer();
    } else if (missing < 0) {
        CFE_EVS_SendEvent(SOCKET_EID, CFE_EVS_EventType_ERROR, "not a message of maxq");
        disconnect();
    }
}

void MAXQ_APP_Main(void)
{
    app.run_status = CFE_ES_RunStatus_APP_RUN;
    if (start() != CFE_SUCCESS) {
        app.run_status = CFE_ES_RunStatus_APP_ERROR;
    }
    while (CFE_ES_RunLoop(&app.run_status)) {
        if (MAXQ_APP_Config.stream) {
            serve_stream();
        } else {
            serve_datagram();
        }
    }
    CFE_ES_ExitApp(app.run_status);
}
