/* A flight computer in a process of its own: answers the simulator over TCP or UDP with the law it is linked with.
 *
 *   cc -std=c99 -O2 -o computer computer.c pd_law.c -lm
 *   ./computer tcp 5005 &
 *   simrun nominal --set vehicle.computer.law=external --set vehicle.computer.address=tcp://127.0.0.1:5005
 *
 * Serves one flight after the other, of one simulator at a time, in version 1 of maxq_fsw.h or, with
 * vehicle.computer.interface=2, in version 2; port 0 takes a free one and prints it. The messages are in link.h. On a
 * target, put its own transport in place of the sockets, as cfs/maxq_app.c does.
 */
#define _POSIX_C_SOURCE 200112L

#include "link.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

/* Receive a message of a stream. */
static int received(int from, link_state *l)
{
    long missing = link_missing(l);
    while (missing > 0) {
        const ssize_t part = recv(from, (char *)&l->message + l->have, (size_t)missing, 0);
        if (part <= 0) {
            return 0;
        }
        l->have += (size_t)part;
        missing = link_missing(l);
    }
    return missing == 0;
}

static void serve_stream(int connected, link_state *l)
{
    while (received(connected, l)) {
        const size_t size = link_answer(l);
        if (!l->running && size == 0) {
            return;
        }
        if (size > 0 && send(connected, &l->reply, size, 0) != (ssize_t)size) {
            return;
        }
    }
}

static void serve_datagrams(int bound, link_state *l)
{
    for (;;) {
        struct sockaddr_storage sender;
        socklen_t length = sizeof sender;
        const ssize_t got = recvfrom(bound, &l->message, sizeof l->message, 0, (struct sockaddr *)&sender, &length);
        l->have = got > 0 ? (size_t)got : 0;
        if (link_missing(l) == 0) {
            const size_t size = link_answer(l);
            if (size > 0) {
                (void)sendto(bound, &l->reply, size, 0, (struct sockaddr *)&sender, length);
            }
        }
    }
}

int main(int argc, char **argv)
{
    const int stream = argc > 1 && strcmp(argv[1], "tcp") == 0, one = 1;
    struct sockaddr_in here;
    socklen_t size = sizeof here;
    const int bound = socket(AF_INET, stream ? SOCK_STREAM : SOCK_DGRAM, 0);
    static link_state state;
    signal(SIGPIPE, SIG_IGN);
    link_start(&state, malloc((size_t)maxq_fsw_bytes()));
    memset(&here, 0, sizeof here);
    here.sin_family = AF_INET;
    here.sin_port = htons((uint16_t)(argc > 2 ? atoi(argv[2]) : 5005));
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    setsockopt(bound, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one);
    if (state.instance == NULL || bind(bound, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("computer");
        return 1;
    }
    getsockname(bound, (struct sockaddr *)&here, &size);
    if (stream) {
        listen(bound, 1);
    }
    printf("%d\n", ntohs(here.sin_port));
    fflush(stdout);
    if (!stream) {
        serve_datagrams(bound, &state);
    }
    for (;;) {
        const int connected = accept(bound, NULL, NULL);
        setsockopt(connected, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
        serve_stream(connected, &state);
        close(connected);
        link_start(&state, state.instance);
    }
}
