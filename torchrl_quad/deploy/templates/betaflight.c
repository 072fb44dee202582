/* Loaded before Betaflight's simulator target (4.6), which stays as it is: its clock, threads and sockets.
 *
 * Time passes as the caller says, a step for each packet through the socket in BETAFLIGHT_STEPS, and the process ends with
 * that socket. The firmware's threads run as coroutines between two steps. No packet reaches a network. Where there is a
 * socket in BETAFLIGHT_CLI, it visits the command line, and the firmware may save its settings.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <netinet/in.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/select.h>
#include <time.h>
#include <ucontext.h>
#include <unistd.h>

enum { CLI, STATE, STICKS, THREADS }; /* in the order in which the firmware starts them */
enum { MOTORS_PORT = 9002, OTHER_LAYOUT = 3 };

static struct {
    int64_t step; /* ns */
    double state[18];
    struct { double time; uint16_t channels[16]; } sticks;
} request;
static float motors[4];
static int64_t now, next_step = 1000000000; /* ns; it boots in the first second */
static int link_fd, cli_fd = -1, threads, running = -1, begun;
static ucontext_t firmware, contexts[THREADS];
static void *(*bodies[THREADS])(void *);
static const void *packet;
static size_t packet_size;

static void body(int i) { bodies[i](NULL); }

static void resume(int i)
{
    running = i;
    swapcontext(&firmware, &contexts[i]);
    running = -1;
}

static void hand(int i, const void *data, size_t size)
{
    packet = data;
    packet_size = size;
    resume(i);
    if (packet) _exit(OTHER_LAYOUT); /* it has not taken it */
}

static void pass(int64_t time)
{
    for (now += time; now >= next_step; next_step += request.step) {
        if (begun++ && send(link_fd, motors, sizeof motors, MSG_NOSIGNAL) != sizeof motors) _exit(0);
        if (recv(link_fd, &request, sizeof request, 0) != sizeof request) _exit(0);
        hand(STICKS, &request.sticks, sizeof request.sticks);
        hand(STATE, request.state, sizeof request.state);
        if (cli_fd >= 0) resume(CLI);
    }
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*start)(void *), void *given)
{
    const int i = threads++;
    const size_t size = 1 << 18;

    if (i >= THREADS) _exit(OTHER_LAYOUT);
    bodies[i] = start;
    getcontext(&contexts[i]);
    contexts[i].uc_stack.ss_sp = malloc(size);
    contexts[i].uc_stack.ss_size = size;
    makecontext(&contexts[i], (void (*)(void))body, 1, i);
    resume(i); /* until it waits for the first time */
    return 0;
}

int pthread_join(pthread_t thread, void **result) { return 0; }

int select(int count, fd_set *reads, fd_set *writes, fd_set *errors, struct timeval *timeout)
{
    const int i = running;
    struct timeval at_once = {0, 0};
    int (*original)(int, fd_set *, fd_set *, fd_set *, struct timeval *);

    swapcontext(&contexts[i], &firmware);
    if (i != CLI) return 1; /* the packet that was handed to it */
    *(void **)&original = dlsym(RTLD_NEXT, "select");
    return original(count, reads, writes, errors, &at_once);
}

ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
    if (size != packet_size) _exit(OTHER_LAYOUT);
    memcpy(data, packet, size);
    packet = NULL;
    return size;
}

ssize_t sendto(int fd, const void *data, size_t size, int flags, const struct sockaddr *to, socklen_t length)
{
    if (ntohs(((const struct sockaddr_in *)to)->sin_port) == MOTORS_PORT) {
        if (size != sizeof motors) _exit(OTHER_LAYOUT);
        memcpy(motors, data, size);
    }
    return size;
}

int clock_gettime(clockid_t clock, struct timespec *result)
{
    if (running < 0) pass(500); /* what passes between two looks at the clock */
    result->tv_sec = (running < 0 ? now : next_step) / 1000000000;
    result->tv_nsec = (running < 0 ? now : next_step) % 1000000000;
    return 0;
}

int nanosleep(const struct timespec *time, struct timespec *rest)
{
    pass(time->tv_sec * 1000000000LL + time->tv_nsec);
    return 0;
}

/* A socket that listens has one visitor: the command line, where there is one. */
int socket(int domain, int type, int protocol) { return eventfd((type & 0xf) == SOCK_STREAM && cli_fd >= 0, EFD_NONBLOCK); }
int bind(int fd, const struct sockaddr *address, socklen_t length) { return 0; }
int listen(int fd, int backlog) { return 0; }
int setsockopt(int fd, int level, int option, const void *value, socklen_t length) { return 0; }

int accept(int fd, struct sockaddr *from, socklen_t *length)
{
    uint64_t visitors;

    return read(fd, &visitors, sizeof visitors) < 0 ? -1 : dup(cli_fd);
}

FILE *fopen(const char *path, const char *mode) /* flights share a folder, and change nothing there */
{
    FILE *(*original)(const char *, const char *);

    *(void **)&original = dlsym(RTLD_NEXT, "fopen");
    return original(path, cli_fd < 0 ? "r" : mode);
}

__attribute__((constructor)) static void begin(void)
{
    link_fd = atoi(getenv("BETAFLIGHT_STEPS"));
    if (getenv("BETAFLIGHT_CLI")) cli_fd = atoi(getenv("BETAFLIGHT_CLI"));
}
