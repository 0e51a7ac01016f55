/* The messages between maxq and a flight computer behind a socket, without the socket: bytes in, bytes out.
 *
 * A transport receives link_missing() bytes at a time into l->message until 0 are missing (or a whole datagram into
 * l->message, then link_missing() has to be 0), and sends the reply that link_answer() has written. The functions
 * allocate no memory and call only memcpy and memset. `simrun schema messages` prints the layout of every message.
 */
#ifndef LINK_H
#define LINK_H

#include "maxq_fsw.h"

#include <stddef.h>
#include <string.h>

enum { LINK_SETUP = 1, LINK_STEP = 2, LINK_END = 3 };
enum { LINK_HEADER = 16, LINK_CODE = 8, LINK_SIZE = 8 };

typedef struct {
    char magic[4];
    uint32_t kind;
    int64_t number;
} link_header;

typedef struct {
    link_header head;
    union {
        maxq_fsw_setup setup;
        maxq_fsw_inputs in;
    } of;
} link_message;

typedef struct {
    link_header head;
    int64_t code;
    maxq_fsw_outputs out;
} link_reply;

typedef struct {
    link_message message;
    link_reply reply;
    size_t have;      /* bytes of the message so far */
    size_t out_bytes; /* of the outputs in the version that the simulator uses */
    int64_t number;   /* of the last message that was answered */
    void *instance;   /* memory of maxq_fsw_bytes() bytes for the flight code */
    int running;
} link_state;

/* Forget an unfinished message and flight; `instance` is the memory for the flight code. */
static void link_start(link_state *l, void *instance)
{
    if (l->running) {
        maxq_fsw_close(l->instance);
    }
    l->have = 0;
    l->number = 0;
    l->running = 0;
    l->instance = instance;
}

/* The bytes still missing, in the order of a stream: header, size of the struct, struct. 0: whole; -1: no message. */
static long link_missing(const link_state *l)
{
    const int64_t size = l->message.of.in.bytes;
    if (l->have < LINK_HEADER) {
        return (long)(LINK_HEADER - l->have);
    }
    if (memcmp(l->message.head.magic, "MAXQ", 4) != 0) {
        return -1;
    }
    if (l->message.head.kind == LINK_END) {
        return 0;
    }
    if (l->have < LINK_HEADER + LINK_SIZE) {
        return (long)(LINK_HEADER + LINK_SIZE - l->have);
    }
    if (size < LINK_SIZE || size > (int64_t)sizeof l->message.of || (int64_t)l->have > LINK_HEADER + size) {
        return -1;
    }
    return (long)(LINK_HEADER + size - (int64_t)l->have);
}

/* Call the flight code for a whole message, and return the size of l->reply, which is to be sent. Return 0 for the end of
 * a flight and for a duplicate of a datagram, which has no answer: the code must see each sample once. */
static size_t link_answer(link_state *l)
{
    const link_header head = l->message.head;
    size_t size = LINK_HEADER + LINK_CODE;
    l->have = 0;
    if (head.kind == LINK_STEP && (!l->running || head.number != l->number + 1)) {
        return 0;
    }
    if (head.kind != LINK_STEP) {
        link_start(l, l->instance);
    }
    if (head.kind == LINK_END) {
        return 0;
    }
    memset(&l->reply, 0, sizeof l->reply);
    l->reply.head = head;
    l->number = head.number;
    if (head.kind == LINK_SETUP) {
        l->out_bytes = l->message.of.setup.abi < 2 ? offsetof(maxq_fsw_outputs, ignition) : sizeof l->reply.out;
        memset(l->instance, 0, (size_t)maxq_fsw_bytes());
        l->reply.code = maxq_fsw_init(l->instance, &l->message.of.setup);
        l->running = l->reply.code == 0;
    } else {
        l->reply.out.bytes = (int64_t)l->out_bytes;
        l->reply.code = maxq_fsw_step(l->instance, &l->message.of.in, &l->reply.out);
        size += l->out_bytes;
    }
    return size;
}

#endif
