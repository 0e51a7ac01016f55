/* A flight computer in a process of its own: answers the simulator over TCP or UDP with the law it is linked with.
 *
 *   cc -std=c99 -O2 -o computer computer.c pd_law.c -lm
 *   ./computer tcp 5005 &
 *   simrun nominal --set vehicle.computer.law=external --set vehicle.computer.address=tcp://127.0.0.1:5005
 *
 * Serves one flight after the other, of one simulator at a time, in version 1 of maxq_fsw.h or, with
 * vehicle.computer.interface=2, in version 2; port 0 takes a free one and prints it. On a target, put its own transport in
 * place of the sockets: docs/flight-software.md has the messages.
 */
#define _POSIX_C_SOURCE 200112L

#include "maxq_fsw.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { SETUP = 1, STEP = 2, END = 3 };

typedef struct {
    char magic[4];
    uint32_t kind;
    int64_t number;
} header;

typedef struct {
    header head;
    union {
        maxq_fsw_setup setup;
        maxq_fsw_inputs in;
    } of;
} message;

typedef struct {
    header head;
    int64_t code;
    maxq_fsw_outputs out;
} answer;

static int received(int from, void *to, size_t size)
{
    size_t have = 0;
    while (have < size) {
        const ssize_t part = recv(from, (char *)to + have, size - have, 0);
        if (part <= 0) {
            return 0;
        }
        have += (size_t)part;
    }
    return 1;
}

/* The next message of a stream, or the next datagram, whose sender is then the one to answer. */
static int next(int from, int stream, message *m)
{
    if (!stream) {
        struct sockaddr_storage sender;
        socklen_t size = sizeof sender;
        const ssize_t got = recvfrom(from, m, sizeof *m, 0, (struct sockaddr *)&sender, &size);
        return got >= (ssize_t)sizeof m->head && connect(from, (struct sockaddr *)&sender, size) == 0;
    }
    if (!received(from, &m->head, sizeof m->head)) {
        return 0;
    }
    if (m->head.kind == END) {
        return 1;
    }
    /* a struct begins with its size, which depends on the version that the simulator uses */
    return received(from, &m->of.in.bytes, sizeof m->of.in.bytes) && m->of.in.bytes >= 8
        && m->of.in.bytes <= (int64_t)sizeof m->of
        && received(from, (char *)&m->of + sizeof m->of.in.bytes, (size_t)m->of.in.bytes - sizeof m->of.in.bytes);
}

static void serve(int from, int stream, void *instance)
{
    message m;
    size_t out_size = sizeof(maxq_fsw_outputs);
    while (next(from, stream, &m) && memcmp(m.head.magic, "MAXQ", 4) == 0 && m.head.kind != END) {
        answer a;
        size_t size = offsetof(answer, out);
        memset(&a, 0, sizeof a);
        a.head = m.head;
        a.out.bytes = (int64_t)out_size;
        if (m.head.kind == SETUP) {
            out_size = m.of.setup.abi < 2 ? offsetof(maxq_fsw_outputs, ignition) : sizeof a.out;
            memset(instance, 0, (size_t)maxq_fsw_bytes());
            a.code = maxq_fsw_init(instance, &m.of.setup);
        } else {
            a.code = maxq_fsw_step(instance, &m.of.in, &a.out);
            size += out_size;
        }
        if (send(from, &a, size, 0) != (ssize_t)size) {
            break;
        }
    }
    maxq_fsw_close(instance);
}

int main(int argc, char **argv)
{
    const int stream = argc > 1 && strcmp(argv[1], "tcp") == 0, one = 1;
    const int port = argc > 2 ? atoi(argv[2]) : 5005;
    void *instance = malloc((size_t)maxq_fsw_bytes());
    for (;;) {
        struct sockaddr_in here;
        socklen_t size = sizeof here;
        const int bound = socket(AF_INET, stream ? SOCK_STREAM : SOCK_DGRAM, 0);
        memset(&here, 0, sizeof here);
        here.sin_family = AF_INET;
        here.sin_port = htons((uint16_t)port);
        here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        setsockopt(bound, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one);
        if (instance == NULL || bind(bound, (struct sockaddr *)&here, sizeof here) != 0) {
            perror("computer");
            return 1;
        }
        getsockname(bound, (struct sockaddr *)&here, &size);
        if (stream) {
            listen(bound, 1);
        }
        printf("%d\n", ntohs(here.sin_port));
        fflush(stdout);
        if (stream) {
            for (;;) {
                const int connected = accept(bound, NULL, NULL);
                setsockopt(connected, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
                serve(connected, 1, instance);
                close(connected);
            }
        }
        serve(bound, 0, instance);
        close(bound); /* a new socket listens to everybody again */
    }
}
