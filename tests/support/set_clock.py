"""The clock of the system, set for some processes only, while they run, by a library that is loaded first."""

import shutil
import struct
import subprocess
from pathlib import Path

import pytest

# Of the C library, and of the kernel, which waits until a time of the true clock.
SOURCE = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile long long *offset;  /* ns */

__attribute__((constructor)) static void begin(void) {
    const char *name = getenv("CLOCK_OFFSET");
    int file = name ? open(name, O_RDONLY) : -1;
    void *found = file < 0 ? MAP_FAILED : mmap(0, 8, PROT_READ, MAP_SHARED, file, 0);
    if (found != MAP_FAILED) offset = found;
}

static void move(struct timespec *time, int sign) {
    long long ns = time->tv_nsec + sign * (offset ? *offset : 0);
    time->tv_sec += ns / 1000000000;
    time->tv_nsec = ns % 1000000000;
    if (time->tv_nsec < 0) { time->tv_nsec += 1000000000; time->tv_sec -= 1; }
}

int clock_gettime(clockid_t clock, struct timespec *found) {
    int failed = syscall(SYS_clock_gettime, clock, found);
    if (!failed && clock == CLOCK_REALTIME) move(found, 1);
    return failed;
}

int gettimeofday(struct timeval *found, void *zone) {
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    found->tv_sec = now.tv_sec;
    found->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *found) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (found) *found = now.tv_sec;
    return now.tv_sec;
}

typedef int (*Wait)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *until) {
    static Wait next;
    if (!next) next = (Wait)dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");  /* not an older one */
    if (!next) next = (Wait)dlsym(RTLD_NEXT, "pthread_cond_timedwait");
    struct timespec truly = *until;
    move(&truly, -1);
    return next(condition, mutex, &truly);
}
"""


class SetClock:
    """The clock of the processes that have ``environment``."""

    def __init__(self, directory: Path) -> None:
        if shutil.which("gcc") is None:
            pytest.skip("no gcc, which makes a clock that can be set")
        library, self._offset = directory / "set_clock.so", directory / "clock_offset"
        command = ["gcc", "-shared", "-fPIC", "-o", library, "-x", "c", "-", "-ldl"]
        subprocess.run(command, input=SOURCE, text=True, check=True)
        self._offset.write_bytes(struct.pack("q", 0))
        self.environment = {"LD_PRELOAD": str(library), "CLOCK_OFFSET": str(self._offset)}

    def set_ahead(self, seconds: float) -> None:
        """Set it ahead of the true clock; negative: behind it."""
        with self._offset.open("r+b") as file:
            file.write(struct.pack("q", round(1e9 * seconds)))
