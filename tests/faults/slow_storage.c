/* Preloaded into a sweep's programs: while the file SLOW_STORAGE_FLAG is there, each operation on a path below the
   folder SLOW_STORAGE takes SLOW_STORAGE_S seconds. A process that met one leaves a file, SLOW_STORAGE_FLAG.PID. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static int is_below(const char *path) {
    const char *folder = getenv("SLOW_STORAGE");
    char here[PATH_MAX], whole[2 * PATH_MAX];
    if (!folder || !path) return 0;
    if (path[0] != '/') {
        if (syscall(SYS_getcwd, here, sizeof here) < 0) return 0;
        snprintf(whole, sizeof whole, "%s/%s", here, path);
        path = whole;
    }
    return strncmp(path, folder, strlen(folder)) == 0;
}

static void wait_if_below(const char *path) {
    const char *flag = getenv("SLOW_STORAGE_FLAG"), *seconds = getenv("SLOW_STORAGE_S");
    char met[PATH_MAX];
    if (!flag || !seconds || !is_below(path) || syscall(SYS_faccessat, AT_FDCWD, flag, F_OK) != 0) return;
    snprintf(met, sizeof met, "%s.%ld", flag, syscall(SYS_getpid));
    long made = syscall(SYS_openat, AT_FDCWD, met, O_CREAT | O_WRONLY, 0644);
    if (made >= 0) syscall(SYS_close, made);
    struct timespec duration = {atoi(seconds), 0};
    nanosleep(&duration, NULL);
}

static void wait_if_descriptor_below(int descriptor) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    long length = syscall(SYS_readlinkat, AT_FDCWD, link, path, sizeof path - 1);
    if (length > 0) {
        path[length] = 0;
        wait_if_below(path);
    }
}

/* Paths relative to an open folder: that folder is below, or the path is. */
static void wait_if_at(int folder, const char *path) {
    if (path && path[0] != '/' && folder != AT_FDCWD)
        wait_if_descriptor_below(folder);
    else
        wait_if_below(path);
}

#define ORIGINAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define MODE(flags) \
    mode_t mode = 0; \
    if ((flags) & (O_CREAT | __O_TMPFILE)) { \
        va_list rest; \
        va_start(rest, flags); \
        mode = va_arg(rest, mode_t); \
        va_end(rest); \
    }

int open(const char *path, int flags, ...) { MODE(flags) wait_if_below(path); return ORIGINAL(open)(path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) wait_if_below(path); return ORIGINAL(open64)(path, flags, mode); }
int openat(int at, const char *path, int flags, ...) { MODE(flags) wait_if_at(at, path); return ORIGINAL(openat)(at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE(flags) wait_if_at(at, path); return ORIGINAL(openat64)(at, path, flags, mode); }
FILE *fopen(const char *path, const char *mode) { wait_if_below(path); return ORIGINAL(fopen)(path, mode); }
FILE *fopen64(const char *path, const char *mode) { wait_if_below(path); return ORIGINAL(fopen64)(path, mode); }
int rename(const char *from, const char *to) { wait_if_below(to); return ORIGINAL(rename)(from, to); }
int renameat(int a, const char *from, int b, const char *to) { wait_if_at(b, to); return ORIGINAL(renameat)(a, from, b, to); }
int mkdir(const char *path, mode_t mode) { wait_if_below(path); return ORIGINAL(mkdir)(path, mode); }
int rmdir(const char *path) { wait_if_below(path); return ORIGINAL(rmdir)(path); }
int unlink(const char *path) { wait_if_below(path); return ORIGINAL(unlink)(path); }
int unlinkat(int at, const char *path, int flags) { wait_if_at(at, path); return ORIGINAL(unlinkat)(at, path, flags); }
int stat(const char *path, struct stat *found) { wait_if_below(path); return ORIGINAL(stat)(path, found); }
int lstat(const char *path, struct stat *found) { wait_if_below(path); return ORIGINAL(lstat)(path, found); }
int stat64(const char *path, struct stat64 *found) { wait_if_below(path); return ORIGINAL(stat64)(path, found); }
int lstat64(const char *path, struct stat64 *found) { wait_if_below(path); return ORIGINAL(lstat64)(path, found); }
int fstatat(int at, const char *path, struct stat *found, int flags) { wait_if_at(at, path); return ORIGINAL(fstatat)(at, path, found, flags); }
int fstatat64(int at, const char *path, struct stat64 *found, int flags) { wait_if_at(at, path); return ORIGINAL(fstatat64)(at, path, found, flags); }
DIR *opendir(const char *path) { wait_if_below(path); return ORIGINAL(opendir)(path); }
int fsync(int descriptor) { wait_if_descriptor_below(descriptor); return ORIGINAL(fsync)(descriptor); }
int fdatasync(int descriptor) { wait_if_descriptor_below(descriptor); return ORIGINAL(fdatasync)(descriptor); }
