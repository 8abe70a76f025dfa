/* Makes User Mode Linux before 6.13 run on CPUs with AMX. vcan.sh compiles and preloads it where it is needed.
 *
 * Such a kernel keeps the extended registers of a process (x87 to AVX-512) in an area of fixed size. The host accepts only
 * an area for all registers of the CPU, which AMX makes larger. So every PTRACE_SETREGSET fails with EFAULT, and the guest
 * dies at its first process. This library copies the guest's area into one of the host's size. The rest of that area (AMX
 * tiles) is unused, since no process of the guest can switch AMX on.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

static long (*next)(int, int, void *, void *);
static char area[65536] __attribute__((aligned(64)));
static struct iovec whole = {area, 0};

static __attribute__((constructor)) void find(void)
{
    next = (long (*)(int, int, void *, void *))dlsym(RTLD_NEXT, "ptrace");
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list rest;
    va_start(rest, request);
    int pid = va_arg(rest, int);
    void *address = va_arg(rest, void *), *data = va_arg(rest, void *);
    va_end(rest);
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
        const struct iovec *part = data;
        if (!whole.iov_len) { /* the first call reads the size of the host's area and the registers after the guest's part */
            whole.iov_len = sizeof area;
            if (next(PTRACE_GETREGSET, pid, address, &whole))
                whole.iov_len = 0;
        }
        if (part->iov_len < whole.iov_len) {
            memcpy(area, part->iov_base, part->iov_len);
            return next(request, pid, address, &whole);
        }
    }
    return next(request, pid, address, data);
}
