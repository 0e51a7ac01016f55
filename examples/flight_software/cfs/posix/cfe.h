/* The functions of cFE and OSAL that maxq_app.c uses, for POSIX: the names, arguments and meanings of the originals. */
#ifndef CFE_H
#define CFE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef int32_t int32;
typedef uint16_t uint16;
typedef uint32_t uint32;
typedef int32 CFE_Status_t;
typedef uint32 osal_id_t;

#define CFE_SUCCESS 0
#define CFE_STATUS_EXTERNAL_RESOURCE_FAIL (-1)
#define CFE_EVS_EventFilter_BINARY 0
enum { CFE_EVS_EventType_DEBUG = 1, CFE_EVS_EventType_INFORMATION, CFE_EVS_EventType_ERROR };
enum { CFE_ES_RunStatus_APP_RUN = 1, CFE_ES_RunStatus_APP_EXIT, CFE_ES_RunStatus_APP_ERROR };

bool CFE_ES_RunLoop(uint32 *run_status);
void CFE_ES_ExitApp(uint32 exit_status);
CFE_Status_t CFE_EVS_Register(const void *filters, uint16 count, uint16 scheme);
CFE_Status_t CFE_EVS_SendEvent(uint16 id, uint16 type, const char *text, ...);

#define OS_SUCCESS 0
#define OS_ERROR (-1)
#define OS_ERROR_TIMEOUT (-8)
#define OS_OBJECT_ID_UNDEFINED ((osal_id_t)0)
#define OS_ObjectIdDefined(id) ((id) != OS_OBJECT_ID_UNDEFINED)

typedef enum { OS_SocketDomain_INVALID, OS_SocketDomain_INET } OS_SocketDomain_t;
typedef enum { OS_SocketType_INVALID, OS_SocketType_DATAGRAM, OS_SocketType_STREAM } OS_SocketType_t;

typedef struct {
    size_t ActualLength;
    uint32 AddrData[7];
} OS_SockAddr_t;

int32 OS_SocketAddrInit(OS_SockAddr_t *address, OS_SocketDomain_t domain);
int32 OS_SocketAddrFromString(OS_SockAddr_t *address, const char *text);
int32 OS_SocketAddrSetPort(OS_SockAddr_t *address, uint16 port);
int32 OS_SocketOpen(osal_id_t *id, OS_SocketDomain_t domain, OS_SocketType_t type);
int32 OS_SocketBind(osal_id_t id, const OS_SockAddr_t *address);
int32 OS_SocketAccept(osal_id_t id, osal_id_t *connected, OS_SockAddr_t *address, int32 timeout_ms);
int32 OS_SocketRecvFrom(osal_id_t id, void *to, size_t size, OS_SockAddr_t *sender, int32 timeout_ms);
int32 OS_SocketSendTo(osal_id_t id, const void *from, size_t size, const OS_SockAddr_t *receiver);
int32 OS_TimedRead(osal_id_t id, void *to, size_t size, int32 timeout_ms);
int32 OS_TimedWrite(osal_id_t id, const void *from, size_t size, int32 timeout_ms);
int32 OS_close(osal_id_t id);

#endif
