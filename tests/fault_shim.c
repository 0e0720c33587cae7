/* Lets one call below a folder fail, once: compiled by faulty_disk.py and preloaded into a process.

   What fails, and with which error, stands in a file that the process shares with the test (see `struct control`), so
   that processes which are started by the process are reached as well. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { READS = 1, WRITES = 2 };

struct control {
    _Atomic int64_t calls; /* below the folder, of the kinds that may fail */
    int64_t at;            /* the number of the call that fails */
    int32_t error;
    int32_t kinds;
    _Atomic int32_t fired;
    char folder[1024]; /* empty: nothing is counted */
    char what[1024];   /* the call that failed */
};

#define N_FILES 65536
static struct control *control;
static _Atomic char below[N_FILES]; /* descriptors of files below the folder */
static DIR *volatile listings[256];

__attribute__((constructor)) static void begin(void) {
    const char *name = getenv("FAULT_CONTROL");
    if (!name) return;
    int file = (int)(intptr_t)openat(AT_FDCWD, name, O_RDWR);
    if (file < 0) return;
    void *shared = mmap(NULL, sizeof(struct control), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (shared != MAP_FAILED) control = shared;
}

static int is_below_path(const char *path) {
    if (!control || !path || !control->folder[0]) return 0;
    size_t size = strlen(control->folder);
    return strncmp(path, control->folder, size) == 0 && (path[size] == '/' || path[size] == 0);
}

static int is_below_file(int file) { return control && control->folder[0] && file >= 0 && file < N_FILES && below[file]; }

static int is_below(int folder, const char *path) {
    return path && path[0] == '/' ? is_below_path(path) : folder != AT_FDCWD && is_below_file(folder);
}

static int fails(int is_concerned, int kind, const char *call, const char *path, int file) {
    if (!is_concerned || !(control->kinds & kind)) return 0;
    int64_t number = atomic_fetch_add(&control->calls, 1);
    if (number != control->at) return 0;
    char name[512] = "";
    if (!path) {
        char link[64];
        snprintf(link, sizeof link, "/proc/self/fd/%d", file);
        ssize_t size = readlink(link, name, sizeof name - 1);
        name[size > 0 ? size : 0] = 0;
    }
    snprintf(control->what, sizeof control->what, "%s %s", call, path ? path : name);
    control->fired = 1;
    errno = control->error;
    return 1;
}

static int marked(int file, int is_concerned) {
    if (file >= 0 && file < N_FILES) below[file] = (char)is_concerned;
    return file;
}

#define REAL(name) static typeof(name) *real; if (!real) real = (typeof(name) *)dlsym(RTLD_NEXT, #name)
#define IS_WRITING(flags) (((flags) & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)) ? WRITES : READS)
#define MODE mode_t mode = 0; \
    if (flags & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }

#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        REAL(name); MODE; \
        int concerns = is_below_path(path); \
        if (fails(concerns, IS_WRITING(flags), #name, path, -1)) return -1; \
        return marked(real(path, flags, mode), concerns); \
    }
OPEN(open) OPEN(open64)

#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) { \
        REAL(name); MODE; \
        int concerns = is_below(folder, path); \
        if (fails(concerns, IS_WRITING(flags), #name, path, -1)) return -1; \
        return marked(real(folder, path, flags, mode), concerns); \
    }
OPENAT(openat) OPENAT(openat64)

int close(int file) {
    REAL(close);
    if (file >= 0 && file < N_FILES) below[file] = 0;
    return real(file);
}

/* Calls on an open file: type, name, parameters, arguments. */
#define ON_FILE(type, name, kind, parameters, ...) \
    type name parameters { \
        REAL(name); \
        if (fails(is_below_file(file), kind, #name, NULL, file)) return (type)-1; \
        return real(__VA_ARGS__); \
    }
ON_FILE(ssize_t, read, READS, (int file, void *into, size_t size), file, into, size)
ON_FILE(ssize_t, pread, READS, (int file, void *into, size_t size, off_t at), file, into, size, at)
ON_FILE(ssize_t, pread64, READS, (int file, void *into, size_t size, off64_t at), file, into, size, at)
ON_FILE(ssize_t, readv, READS, (int file, const struct iovec *parts, int n), file, parts, n)
ON_FILE(ssize_t, preadv, READS, (int file, const struct iovec *parts, int n, off_t at), file, parts, n, at)
ON_FILE(ssize_t, preadv64, READS, (int file, const struct iovec *parts, int n, off64_t at), file, parts, n, at)
ON_FILE(ssize_t, write, WRITES, (int file, const void *from, size_t size), file, from, size)
ON_FILE(ssize_t, pwrite, WRITES, (int file, const void *from, size_t size, off_t at), file, from, size, at)
ON_FILE(ssize_t, pwrite64, WRITES, (int file, const void *from, size_t size, off64_t at), file, from, size, at)
ON_FILE(ssize_t, writev, WRITES, (int file, const struct iovec *parts, int n), file, parts, n)
ON_FILE(int, fsync, WRITES, (int file), file)
ON_FILE(int, fdatasync, WRITES, (int file), file)
ON_FILE(int, ftruncate, WRITES, (int file, off_t size), file, size)
ON_FILE(int, ftruncate64, WRITES, (int file, off64_t size), file, size)

ssize_t sendfile64(int into, int file, off64_t *at, size_t size) {
    REAL(sendfile64);
    if (fails(is_below_file(file), READS, "sendfile", NULL, file)) return -1;
    return real(into, file, at, size);
}
ssize_t sendfile(int into, int file, off_t *at, size_t size) {
    REAL(sendfile);
    if (fails(is_below_file(file), READS, "sendfile", NULL, file)) return -1;
    return real(into, file, at, size);
}
ssize_t copy_file_range(int file, off64_t *from, int into, off64_t *to, size_t size, unsigned flags) {
    REAL(copy_file_range);
    if (fails(is_below_file(file), READS, "copy_file_range", NULL, file)) return -1;
    return real(file, from, into, to, size, flags);
}

#define MAP(name, offset) \
    void *name(void *where, size_t size, int protection, int flags, int file, offset at) { \
        REAL(name); \
        if (file >= 0 && fails(is_below_file(file), READS, #name, NULL, file)) return MAP_FAILED; \
        return real(where, size, protection, flags, file, at); \
    }
MAP(mmap, off_t) MAP(mmap64, off64_t)

/* Calls with a path. */
#define ON_PATH(name, kind, parameters, ...) \
    int name parameters { \
        REAL(name); \
        if (fails(is_below_path(path), kind, #name, path, -1)) return -1; \
        return real(__VA_ARGS__); \
    }
ON_PATH(unlink, WRITES, (const char *path), path)
ON_PATH(rmdir, WRITES, (const char *path), path)
ON_PATH(mkdir, WRITES, (const char *path, mode_t mode), path, mode)
ON_PATH(rename, WRITES, (const char *path, const char *to), path, to)
ON_PATH(link, WRITES, (const char *path, const char *to), path, to)
ON_PATH(stat, READS, (const char *path, struct stat *into), path, into)
ON_PATH(lstat, READS, (const char *path, struct stat *into), path, into)
ON_PATH(stat64, READS, (const char *path, struct stat64 *into), path, into)
ON_PATH(lstat64, READS, (const char *path, struct stat64 *into), path, into)

int symlink(const char *content, const char *path) {
    REAL(symlink);
    if (fails(is_below_path(path), WRITES, "symlink", path, -1)) return -1;
    return real(content, path);
}

#define AT_PATH(name, kind, parameters, ...) \
    int name parameters { \
        REAL(name); \
        if (fails(is_below(folder, path), kind, #name, path, -1)) return -1; \
        return real(__VA_ARGS__); \
    }
AT_PATH(unlinkat, WRITES, (int folder, const char *path, int flags), folder, path, flags)
AT_PATH(mkdirat, WRITES, (int folder, const char *path, mode_t mode), folder, path, mode)
AT_PATH(renameat, WRITES, (int folder, const char *path, int other, const char *to), folder, path, other, to)
AT_PATH(linkat, WRITES, (int folder, const char *path, int other, const char *to, int flags), folder, path, other, to, flags)
AT_PATH(fstatat, READS, (int folder, const char *path, struct stat *into, int flags), folder, path, into, flags)
AT_PATH(fstatat64, READS, (int folder, const char *path, struct stat64 *into, int flags), folder, path, into, flags)
AT_PATH(statx, READS, (int folder, const char *path, int flags, unsigned mask, struct statx *into), folder, path, flags, mask, into)

/* What programs call that were built for an older C library. */
#define OLD_STAT(name, type) \
    int name(int version, const char *path, type *into); \
    int name(int version, const char *path, type *into) { \
        REAL(name); \
        if (fails(is_below_path(path), READS, #name, path, -1)) return -1; \
        return real(version, path, into); \
    }
OLD_STAT(__xstat, struct stat) OLD_STAT(__lxstat, struct stat)
OLD_STAT(__xstat64, struct stat64) OLD_STAT(__lxstat64, struct stat64)

/* Folders. */
static DIR *listed(DIR *listing, int concerns) {
    for (int i = 0; concerns && listing && i < 256; i++)
        if (!listings[i]) { listings[i] = listing; break; }
    return listing;
}
DIR *opendir(const char *path) {
    REAL(opendir);
    int concerns = is_below_path(path);
    if (fails(concerns, READS, "opendir", path, -1)) return NULL;
    return listed(real(path), concerns);
}
DIR *fdopendir(int file) {
    REAL(fdopendir);
    int concerns = is_below_file(file);
    if (fails(concerns, READS, "fdopendir", NULL, file)) return NULL;
    return listed(real(file), concerns);
}
int closedir(DIR *listing) {
    REAL(closedir);
    for (int i = 0; i < 256; i++)
        if (listings[i] == listing) listings[i] = NULL;
    marked(dirfd(listing), 0);
    return real(listing);
}
static int is_below_listing(DIR *listing) {
    for (int i = 0; control && control->folder[0] && i < 256; i++)
        if (listings[i] == listing) return 1;
    return 0;
}
struct dirent *readdir(DIR *listing) {
    REAL(readdir);
    if (fails(is_below_listing(listing), READS, "readdir", NULL, dirfd(listing))) return NULL;
    return real(listing);
}
struct dirent64 *readdir64(DIR *listing) {
    REAL(readdir64);
    if (fails(is_below_listing(listing), READS, "readdir64", NULL, dirfd(listing))) return NULL;
    return real(listing);
}
