/* cFE and OSAL as far as maxq_app.c needs them, on POSIX sockets, with a main(): maxq_app tcp|udp PORT */
#define _POSIX_C_SOURCE 200112L

#include "cfe.h"
#include "maxq_app.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

/* ids are descriptors plus 1, because 0 is OS_OBJECT_ID_UNDEFINED */
static int descriptor(osal_id_t id)
{
    return (int)id - 1;
}

static struct sockaddr_in *in(const OS_SockAddr_t *address)
{
    return (struct sockaddr_in *)(uintptr_t)address->AddrData;
}

/* Wait until an event; OS_SUCCESS, OS_ERROR_TIMEOUT or OS_ERROR. */
static int32 await(osal_id_t id, short event, int32 timeout_ms)
{
    struct pollfd one;
    int found;
    one.fd = descriptor(id);
    one.events = event;
    one.revents = 0;
    found = poll(&one, 1, timeout_ms);
    return found > 0 ? OS_SUCCESS : found == 0 ? OS_ERROR_TIMEOUT : OS_ERROR;
}

int32 OS_SocketAddrInit(OS_SockAddr_t *address, OS_SocketDomain_t domain)
{
    memset(address, 0, sizeof *address);
    address->ActualLength = sizeof(struct sockaddr_in);
    in(address)->sin_family = AF_INET;
    return domain == OS_SocketDomain_INET ? OS_SUCCESS : OS_ERROR;
}

int32 OS_SocketAddrFromString(OS_SockAddr_t *address, const char *text)
{
    return inet_pton(AF_INET, text, &in(address)->sin_addr) == 1 ? OS_SUCCESS : OS_ERROR;
}

int32 OS_SocketAddrSetPort(OS_SockAddr_t *address, uint16 port)
{
    in(address)->sin_port = htons(port);
    return OS_SUCCESS;
}

int32 OS_SocketOpen(osal_id_t *id, OS_SocketDomain_t domain, OS_SocketType_t type)
{
    const int one = 1;
    const int made = socket(AF_INET, type == OS_SocketType_STREAM ? SOCK_STREAM : SOCK_DGRAM, 0);
    *id = (osal_id_t)(made + 1);
    setsockopt(made, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one);
    return made >= 0 && domain == OS_SocketDomain_INET ? OS_SUCCESS : OS_ERROR;
}

int32 OS_SocketBind(osal_id_t id, const OS_SockAddr_t *address)
{
    int type = 0;
    socklen_t size = sizeof type;
    if (bind(descriptor(id), (struct sockaddr *)in(address), (socklen_t)address->ActualLength) != 0) {
        return OS_ERROR;
    }
    getsockopt(descriptor(id), SOL_SOCKET, SO_TYPE, &type, &size);
    return type == SOCK_DGRAM || listen(descriptor(id), 1) == 0 ? OS_SUCCESS : OS_ERROR;
}

int32 OS_SocketAccept(osal_id_t id, osal_id_t *connected, OS_SockAddr_t *address, int32 timeout_ms)
{
    socklen_t size = sizeof address->AddrData;
    const int32 status = await(id, POLLIN, timeout_ms);
    int made;
    if (status != OS_SUCCESS) {
        return status;
    }
    made = accept(descriptor(id), (struct sockaddr *)in(address), &size);
    *connected = (osal_id_t)(made + 1);
    return made >= 0 ? OS_SUCCESS : OS_ERROR;
}

int32 OS_SocketRecvFrom(osal_id_t id, void *to, size_t size, OS_SockAddr_t *sender, int32 timeout_ms)
{
    socklen_t length = sizeof sender->AddrData;
    const int32 status = await(id, POLLIN, timeout_ms);
    ssize_t got;
    if (status != OS_SUCCESS) {
        return status;
    }
    got = recvfrom(descriptor(id), to, size, 0, (struct sockaddr *)in(sender), &length);
    sender->ActualLength = length;
    return got >= 0 ? (int32)got : OS_ERROR;
}

int32 OS_SocketSendTo(osal_id_t id, const void *from, size_t size, const OS_SockAddr_t *receiver)
{
    const ssize_t sent = sendto(
        descriptor(id), from, size, 0, (struct sockaddr *)in(receiver), (socklen_t)receiver->ActualLength);
    return sent >= 0 ? (int32)sent : OS_ERROR;
}

int32 OS_TimedRead(osal_id_t id, void *to, size_t size, int32 timeout_ms)
{
    const int32 status = await(id, POLLIN, timeout_ms);
    const ssize_t got = status == OS_SUCCESS ? read(descriptor(id), to, size) : 0;
    return status != OS_SUCCESS ? status : got >= 0 ? (int32)got : OS_ERROR;
}

int32 OS_TimedWrite(osal_id_t id, const void *from, size_t size, int32 timeout_ms)
{
    const int32 status = await(id, POLLOUT, timeout_ms);
    const ssize_t sent = status == OS_SUCCESS ? send(descriptor(id), from, size, 0) : 0;
    return status != OS_SUCCESS ? status : sent >= 0 ? (int32)sent : OS_ERROR;
}

int32 OS_close(osal_id_t id)
{
    return close(descriptor(id)) == 0 ? OS_SUCCESS : OS_ERROR;
}

bool CFE_ES_RunLoop(uint32 *run_status)
{
    return *run_status == CFE_ES_RunStatus_APP_RUN;
}

void CFE_ES_ExitApp(uint32 exit_status)
{
    exit(exit_status == CFE_ES_RunStatus_APP_ERROR ? EXIT_FAILURE : EXIT_SUCCESS);
}

CFE_Status_t CFE_EVS_Register(const void *filters, uint16 count, uint16 scheme)
{
    return filters == NULL && count == 0 && scheme == CFE_EVS_EventFilter_BINARY ? CFE_SUCCESS : OS_ERROR;
}

CFE_Status_t CFE_EVS_SendEvent(uint16 id, uint16 type, const char *text, ...)
{
    va_list more;
    va_start(more, text);
    printf("MAXQ_APP %u%s: ", (unsigned)id, type == CFE_EVS_EventType_ERROR ? " (error)" : "");
    vprintf(text, more);
    printf("\n");
    fflush(stdout);
    va_end(more);
    return CFE_SUCCESS;
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "usage: maxq_app tcp|udp PORT\n");
        return 2;
    }
    signal(SIGPIPE, SIG_IGN);
    MAXQ_APP_Config.stream = strcmp(argv[1], "tcp") == 0;
    MAXQ_APP_Config.port = (uint16_t)atoi(argv[2]);
    MAXQ_APP_Main();
}
