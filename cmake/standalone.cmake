# SPDX-License-Identifier: BSD-3-Clause
# What a build of this checkout by itself, without a catkin workspace around it, needs before it looks for catkin.
# CMake includes this right after the project() of the root.
if(NOT CMAKE_SOURCE_DIR STREQUAL CMAKE_CURRENT_SOURCE_DIR)
  return()
endif()

# The Python that runs catkin's tools, and later the executables: the one of .venv, which has the pinned packages, or
# the first that has ROS's modules. (Another Python may well be first on the PATH.)
if(NOT DEFINED PYTHON_EXECUTABLE)
  find_program(ROSBRIDGE_PYTHON_ON_PATH python3)
  foreach(candidate "${CMAKE_CURRENT_SOURCE_DIR}/.venv/bin/python" "${ROSBRIDGE_PYTHON_ON_PATH}" /usr/bin/python3)
    execute_process(COMMAND "${candidate}" -c "import catkin_pkg, genpy" RESULT_VARIABLE failure OUTPUT_QUIET ERROR_QUIET)
    if(NOT failure)
      set(PYTHON_EXECUTABLE "${candidate}" CACHE FILEPATH "The Python that runs the executables")
      break()
    endif()
  endforeach()
endif()

# catkin writes the install prefix into the files that it installs when it configures, so
# `cmake --install build --prefix elsewhere` would scatter them over two prefixes. This comes before every other install
# rule: for another prefix it configures again, and lets that install instead.
install(CODE "
  get_filename_component(prefix \"\${CMAKE_INSTALL_PREFIX}\" ABSOLUTE)
  if(NOT prefix STREQUAL \"${CMAKE_INSTALL_PREFIX}\")
    execute_process(
      COMMAND \"${CMAKE_COMMAND}\" \"-DCMAKE_INSTALL_PREFIX:PATH=\${prefix}\" \"${CMAKE_BINARY_DIR}\"
      RESULT_VARIABLE failure)
    if(NOT failure)
      execute_process(COMMAND \"${CMAKE_COMMAND}\" --install \"${CMAKE_BINARY_DIR}\" RESULT_VARIABLE failure)
    endif()
    if(failure)
      message(FATAL_ERROR \"Installing to \${prefix} failed: \${failure}\")
    endif()
    return()
  endif()")
